from __future__ import annotations

import numpy as np
import pytest

from rhot_calibration.cameras.live.session import COUNTDOWN_S, FRESH_S, MAX_EDGE_PX, Session, SessionState
from rhot_calibration.cameras.solve.views import Board, BoardView

BOARD = Board(9, 6, 0.025)
SIZES = {"left": (640, 480), "right": (640, 480)}
ROUND_S = 0.2


def seen(u: float, v: float = 200.0, sharpness: float = 1.5) -> BoardView:
    return BoardView(np.arange(54), BOARD.points[:, :2] * 1000.0 + (u, v), sharpness)


class Clocked:
    """A session that is fed every 0.2 s, with a little noise."""

    def __init__(self, session: Session) -> None:
        self.session = session
        self.t_s = 0.0
        self._rng = np.random.default_rng(1)

    def feed(self, **views: BoardView) -> dict[str, BoardView] | None:
        self.t_s += ROUND_S
        noisy = {
            camera: BoardView(one.ids, one.corners + self._rng.normal(0.0, 0.05, one.corners.shape), one.sharpness)
            for camera, one in views.items()
        }
        return self.session.feed(noisy, self.t_s)

    def hold(self, seconds: float = 1.5, **views: BoardView) -> list[SessionState]:
        """Hold the board still; return the states passed through."""
        states = []
        for _ in range(round(seconds / ROUND_S)):
            self.feed(**views)
            states.append(self.session.progress.state)
        return states


@pytest.fixture
def clocked() -> Clocked:
    return Clocked(Session(BOARD, SIZES))


def test_a_board_held_still_is_taken_after_the_countdown(clocked: Clocked) -> None:
    counts = []
    for _ in range(20):
        taken = clocked.feed(left=seen(100.0), right=seen(60.0))
        if taken is not None:
            break
        counts.append(clocked.session.progress.count)
    assert set(taken or {}) == {"left", "right"}
    assert clocked.t_s == pytest.approx(COUNTDOWN_S + 2 * ROUND_S, abs=ROUND_S)
    # 0 in the first round, which cannot tell yet whether the board moves.
    assert counts[0] == 0
    assert counts[1:] == sorted(counts[1:], reverse=True)
    assert set(counts[1:]) == {3, 2, 1}
    views = clocked.session.view_set
    assert set(views.views) == {("left", 0), ("right", 0)}
    assert views.labels["right", 0] == "right/000000.png"
    assert clocked.session.progress.state is SessionState.ACCEPTED


def test_a_moving_board_is_never_taken(clocked: Clocked) -> None:
    for step in range(30):
        assert clocked.feed(left=seen(100.0 + 1.0 * step)) is None
    assert clocked.session.progress.state is SessionState.MOVING


def test_a_jerk_restarts_the_countdown(clocked: Clocked) -> None:
    assert clocked.hold(0.8, left=seen(100.0))[-1] is SessionState.HOLDING
    assert clocked.hold(0.2, left=seen(104.0)) == [SessionState.MOVING]
    assert clocked.session.progress.sets == 0


def test_motion_in_one_camera_alone_counts(clocked: Clocked) -> None:
    for step in range(12):
        assert clocked.feed(left=seen(100.0), right=seen(60.0 + 3.0 * step)) is None


@pytest.mark.parametrize("every", [2, 3, 4])
def test_a_camera_that_misses_rounds_is_waited_for(clocked: Clocked, every: int) -> None:
    """A camera on a busy machine: without its view the set would tie nothing to it."""
    for step in range(12):
        right = {"right": seen(60.0)} if step % every == 0 else {}
        taken = clocked.feed(left=seen(100.0), **right)
        if taken is not None:
            break
    assert set(taken or {}) == {"left", "right"}


def test_a_camera_that_has_gone_is_not_waited_for_for_long(clocked: Clocked) -> None:
    clocked.hold(0.6, left=seen(100.0), right=seen(60.0))
    gone_s = clocked.t_s
    while (taken := clocked.feed(left=seen(100.0))) is None:
        assert clocked.t_s < gone_s + FRESH_S + 2 * ROUND_S
    assert set(taken) == {"left"}


def test_a_camera_that_misses_rounds_while_the_board_moves_takes_nothing(clocked: Clocked) -> None:
    for step in range(12):
        right = {"right": seen(60.0 + 5.0 * step)} if step % 3 == 0 else {}
        assert clocked.feed(left=seen(100.0), **right) is None


def test_a_pause_of_the_previews_is_no_stillness(clocked: Clocked) -> None:
    clocked.hold(0.6, left=seen(100.0))
    clocked.t_s += 5.0
    assert clocked.feed(left=seen(100.0)) is None
    assert clocked.session.progress.state is SessionState.MOVING


def test_the_same_place_is_taken_once(clocked: Clocked) -> None:
    clocked.hold(left=seen(100.0))
    assert clocked.hold(left=seen(100.0))[-1] is SessionState.ACCEPTED
    clocked.feed(left=seen(160.0))
    assert clocked.hold(left=seen(105.0))[-1] is SessionState.SIMILAR
    assert clocked.session.progress.sets == 1
    clocked.hold(left=seen(160.0))
    assert clocked.session.progress.sets == 2


def test_the_same_place_seen_by_another_camera_is_new(clocked: Clocked) -> None:
    clocked.hold(left=seen(100.0))
    clocked.hold(left=seen(100.0), right=seen(60.0))
    assert clocked.session.progress.sets == 2
    assert clocked.session.progress.pairs == {("left", "right"): 1}


def test_a_blurred_picture_is_not_taken(clocked: Clocked) -> None:
    states = clocked.hold(left=seen(100.0, sharpness=MAX_EDGE_PX + 0.5))
    assert states[-1] is SessionState.BLURRED
    assert clocked.session.progress.sets == 0


def test_without_a_board_it_searches(clocked: Clocked) -> None:
    assert clocked.hold()[-1] is SessionState.SEARCHING
    assert clocked.session.progress.missing[:2] == ("left: show it the board", "right: show it the board")


def test_undo_forgets_the_last_set_alone(clocked: Clocked) -> None:
    assert clocked.session.undo() is None
    clocked.hold(left=seen(100.0))
    clocked.hold(left=seen(200.0))
    assert clocked.session.undo() == 1
    assert set(clocked.session.view_set.views) == {("left", 0)}
    clocked.hold(left=seen(200.0))
    assert set(clocked.session.view_set.views) == {("left", 0), ("left", 1)}


def test_enough_sets_are_complete() -> None:
    clocked = Clocked(Session(BOARD, SIZES, enough=2))
    clocked.hold(left=seen(100.0))
    assert not clocked.session.complete
    clocked.hold(left=seen(200.0))
    assert clocked.session.complete


def test_what_is_missing_names_cameras_that_are_not_tied(clocked: Clocked) -> None:
    clocked.hold(left=seen(100.0))
    assert "left | right" in clocked.session.progress.missing[-1]
    assert not clocked.session.complete
