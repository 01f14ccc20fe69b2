"""The pace of a replay, and what it must keep its hands off."""

from __future__ import annotations

import threading
import time

import numpy as np
import pytest

from rhot.recording import player
from rhot.recording.mcap.reader import RecordedSample
from rhot.recording.player import PlayFigures, conflicts, moments, play


def sample(log_ns: int, t_ns: int = 0) -> RecordedSample:
    return RecordedSample("rhot/points", "application/msgpack;PointSet", b"", t_ns, log_ns)


@pytest.mark.parametrize("rate", [0.5, 1.0, 10.0])
def test_samples_leave_in_order_and_spaced_as_they_came(rate: float) -> None:
    log_ns = 10**18 + np.cumsum(np.random.default_rng(1).integers(0, round(20e6 * rate), 60))
    left: list[tuple[int, int]] = []
    figures = PlayFigures()
    play(
        (sample(int(moment)) for moment in log_ns),
        lambda one: left.append((one.log_ns, time.monotonic_ns())),
        rate=rate,
        stopping=threading.Event(),
        figures=figures,
    )
    assert [moment for moment, _ in left] == log_ns.tolist()
    assert figures.sent == 60
    left_ns = np.array([at for _, at in left])
    late_ms = ((left_ns - left_ns[0]) - (log_ns - log_ns[0]) / rate) / 1e6
    # How late is the machine's affair, and measured by `rhot evaluate recording`.
    assert late_ms.min() > -1.0, "none leaves before its time"


@pytest.mark.parametrize(("gap_s", "rate"), [(30.0, 1.0), (3.0 * 365 * 86400, 0.001)])
def test_a_long_pause_is_told_and_ends_at_once_when_asked(gap_s: float, rate: float) -> None:
    stopping, figures = threading.Event(), PlayFigures()
    samples = [sample(0), sample(round(gap_s * 1e9))]
    options = {"rate": rate, "stopping": stopping, "figures": figures}
    thread = threading.Thread(target=play, args=(samples, lambda _: None), kwargs=options)
    thread.start()
    while not figures.waits_s:
        time.sleep(0.001)
    assert figures.waits_s == pytest.approx(gap_s / rate, rel=0.05)
    stopping.set()
    thread.join(2.0)
    assert not thread.is_alive()


def test_a_replay_stops_within_a_wait() -> None:
    stopping = threading.Event()
    figures = PlayFigures()
    samples = [sample(0), sample(3600 * 10**9)]
    options = {"rate": 1.0, "stopping": stopping, "figures": figures}
    thread = threading.Thread(target=play, args=(samples, lambda _: None), kwargs=options)
    thread.start()
    stopping.set()
    thread.join(2.0)
    assert not thread.is_alive()
    assert figures.sent < 2


class Clock(threading.Event):
    """A clock that stands until somebody waits; a stop that nobody asks for."""

    now_ns = 0

    def monotonic_ns(self) -> int:
        return self.now_ns

    def wait(self, timeout: float | None = None) -> bool:
        self.now_ns += round(1e9 * (timeout or 0.0))
        return False


def test_after_a_stall_the_replay_goes_on_at_its_pace(monkeypatch: pytest.MonkeyPatch) -> None:
    left: list[int] = []
    clock = Clock()
    monkeypatch.setattr(player, "time", clock)

    def put(_: RecordedSample) -> None:
        left.append(clock.now_ns)
        if len(left) == 1:
            clock.now_ns += 700_000_000

    figures = PlayFigures()
    samples = [sample(step * 20_000_000) for step in range(10)]
    play(samples, put, rate=1.0, stopping=clock, figures=figures)
    assert figures.fell_behind == 1
    assert (left[-1] - left[1]) / 1e6 == pytest.approx(160.0, abs=0.1), "not in a heap"


def test_a_step_is_what_was_true_at_one_moment() -> None:
    steps = list(moments([sample(1, 5), sample(2, 5), sample(3, 6), sample(4, 5)]))
    assert [[one.log_ns for one in step] for step in steps] == [[1, 2], [3], [4]]


@pytest.mark.parametrize(
    ("key", "alive", "owner"),
    [
        ("rhot/markers/left", "capture/left", True),
        ("rhot/markers/left", "capture/right", False),
        ("rhot/markers/left", "fusion/main", False),
        ("rhot/points", "fusion/main", True),
        ("rhot/hand/right", "ik/main", True),
        ("rhot/hand/right", "fusion/main", False),
        ("rhot/object/cube", "objects/main", True),
        ("rhot/head", "objects/main", True),
        ("rhot/truth", "truth/main", True),
        ("rhot/status/ik/main", "ik/main", True),
        ("rhot/status/ik/main", "ik/second", False),
        ("rhot/config/capture/left", "capture/left", True),
        ("rhot/control", "viewer/main", True),
        ("rhot/points", "replay/main", True),
    ],
)
def test_a_living_service_owns_its_keys(key: str, alive: str, owner: bool) -> None:
    assert conflicts([key], [alive]) == ([(key, alive)] if owner else [])
