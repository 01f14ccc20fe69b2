"""Smoothing: which views show a marker where it is, and how far back from where it began."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest
from hands.pinholes import CAMERAS, FOCAL_PX

from rhot.arrays import FloatArray
from rhot_fusion.filter.initialisation import InitialState
from rhot_fusion.filter.smoothing.smoother import Correct, Event, Node, RecordedFrame, bridged, smooth
from rhot_fusion.filter.state import ROUND, SHARED, State, Views
from rhot_fusion.filter.tracks import CALIBRATED, PAIR_S

PERIOD_S, NOISE_PX, ROW_S = 1.0 / 60.0, 0.1, 0.002
PLACE = np.array([0.02, -0.01, 0.7])
BEGUN = 12


def as_they_are(frames: Sequence[RecordedFrame], _: Sequence[State]) -> list[Views]:
    return [frame.views for frame in frames]


def watched(
    off_px: dict[int, float],
    slack_px: float = 0.0,
    seen_from: int = 0,
    moved_m: float = 0.0,
    correct: Correct = as_they_are,
) -> list[Node]:
    """Return a marker at rest, seen by two cameras in turns and known from frame 12 on, as two views of it began it.

    Args:
        off_px: frame to how far its view is off, which did not move the marker live.
        slack_px: of all views.
        seen_from: the first frame that shows it.
        moved_m: how much further off two views of frame 20 put it anew live, where it may well have moved.
        correct: what is done to the views.
    """
    variance = ROUND[None] * (NOISE_PX / FOCAL_PX) ** 2
    frames: list[RecordedFrame] = []
    for number in range(30):
        camera = number % 2
        local = CAMERAS[camera].to_camera(PLACE[None])
        xy: FloatArray = local[:, :2] / local[:, 2:] + off_px.get(number, 0.0) / FOCAL_PX
        delta, slack = np.array([ROW_S]), np.full(1, slack_px / FOCAL_PX)
        views = Views(CAMERAS[camera], np.zeros(1, dtype=np.intp), delta, xy, variance, slack)
        if number < seen_from:
            views = views.chosen(np.zeros(1, dtype=bool))
        events = []
        if number == BEGUN:
            initial = InitialState(np.concatenate([PLACE, np.zeros(3)]), np.diag([1e-6] * 3 + [1e-2] * 3), 0.0)
            events = [Event(number * PERIOD_S, 0, initial, frames[-1])]
        if number == 20 and moved_m:
            where = PLACE + np.array([0.0, 0.0, moved_m])
            initial = InitialState(np.concatenate([where, np.zeros(3)]), np.diag([1e-6] * 3 + [1e-2] * 3), 0.0)
            events = [Event(number * PERIOD_S, 0, initial, frames[-1], continues=True)]
        taken = np.full(len(views.index), number >= BEGUN - 1 and number not in off_px)
        area_px = np.zeros(len(views.index))
        frames.append(RecordedFrame(number * PERIOD_S, camera, views, taken, events, views.xy, area_px))
    return smooth(frames, 1, CALIBRATED, correct)


@pytest.mark.parametrize(("slack_px", "shown"), [(0.0, False), (1.5, True)])
def test_a_view_that_is_off_for_what_hides_it_still_shows_its_marker(slack_px: float, shown: bool) -> None:
    nodes = watched({20: 4.0}, slack_px)
    assert bool(nodes[20].shown[0]) is shown
    assert nodes[19].shown[0]
    assert nodes[21].shown[0]


def test_a_marker_is_smoothed_back_to_its_first_consistent_views() -> None:
    nodes = watched({8: 30.0}, seen_from=6)
    carried = [n for n, node in enumerate(nodes) if np.isfinite(node.position[0, 0])]
    # Frame 11 began it, though its row came after its moment; frame 8 shows something else.
    assert carried == [*range(6, 30)]
    assert [n for n in carried if not nodes[n].shown[0]] == [8]
    assert max(np.abs(nodes[n].position[0] - PLACE).max() for n in carried) < 2e-3
    assert nodes[6].covariance[0, 2, 2] > nodes[10].covariance[0, 2, 2], "the longer ago, the less sure"


def test_views_that_are_long_ago_are_left_alone() -> None:
    early = next(n for n, node in enumerate(watched({})) if np.isfinite(node.position[0, 0]))
    assert (BEGUN - 1 - early) * PERIOD_S <= PAIR_S + 1e-9


def test_a_marker_that_was_reinitialised_live_is_smoothed_across() -> None:
    nodes = watched({}, moved_m=0.05)
    assert max(np.abs(node.position[0] - PLACE).max() for node in nodes[BEGUN:]) < 2e-3


def test_views_are_understood_anew_by_the_path() -> None:
    told = []

    def nearer(frames: Sequence[RecordedFrame], states: Sequence[State]) -> list[Views]:
        told.append(states[-1].mean[0, 2])
        closer = PLACE * [1.0, 1.0, 0.9]
        return [
            replace(frame.views, xy=local[:, :2] / local[:, 2:])
            for frame in frames
            for local in [frame.views.camera.to_camera(closer[None])[: len(frame.views.index)]]
        ]

    nodes = watched({}, correct=nearer)
    assert told == [pytest.approx(0.7, abs=1e-3)]
    assert nodes[-1].position[0, 2] == pytest.approx(0.63, abs=1e-3)


def test_markers_of_unknown_depth_are_led_to_where_they_were_reinitialised_live() -> None:
    """One camera loses the tips while they bend away from the patch; then both cameras see them again."""
    count, lost, found, bent_m = 4, 10, 80, 0.12
    rest = PLACE + np.array([[-0.03, -0.05, 0.0], [0.0, -0.06, 0.0], [0.03, -0.05, 0.0], [0.0, 0.0, 0.0]])
    variance = ROUND[None].repeat(count, axis=0) * (NOISE_PX / FOCAL_PX) ** 2
    everything, rng = np.arange(count), np.random.default_rng(1)
    tips = everything < count - 1
    frames: list[RecordedFrame] = []

    def bent(number: int) -> FloatArray:
        there: FloatArray = rest.copy()
        there[tips, 2] += bent_m * np.clip((number - lost) / (found - lost), 0.0, 1.0)
        return there

    for number in range(160):
        camera, t_s = number % 2, number * PERIOD_S
        there = bent(number)
        local = CAMERAS[camera].to_camera(there)
        xy: FloatArray = local[:, :2] / local[:, 2:] + rng.normal(0.0, NOISE_PX / FOCAL_PX, (count, 2))
        views = Views(CAMERAS[camera], everything, np.zeros(count), xy, variance, np.zeros(count))
        if camera == 1 and lost <= number < found:
            views = views.chosen(~tips)
        events = []
        if number in (1, found + 1):
            for marker in everything[tips] if number > 1 else everything:
                mean = np.concatenate([there[marker], np.zeros(3)])
                initial = InitialState(mean, np.diag([1e-5] * 3 + [1e-2] * 3), t_s)
                events.append(Event(t_s, int(marker), initial, frames[-1], continues=number > 1))
        taken = np.full(len(views.index), True)
        frames.append(RecordedFrame(t_s, camera, views, taken, events, views.xy, np.zeros(len(views.index))))
    nodes = smooth(frames, count, CALIBRATED, as_they_are)
    spread_m = [np.sqrt(np.trace(node.covariance[0, :3, :3])) for node in nodes]
    off_m = [np.abs(node.position - bent(number)).max() for number, node in enumerate(nodes)]
    assert max(off_m[lost:found]) < 0.01, "81 mm where the path before is not led there"
    assert max(spread_m[found + 2 : -5]) < 5e-3
    assert max(off_m[found + 2 : -5]) < 5e-3


def test_a_marker_that_moved_further_than_assumed_while_hidden_is_led_there_too(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    half, start_s, end_s = 3, 1.0, 1.1
    moved = PLACE + np.array([0.06, 0.0, 0.0])
    sure, x = np.zeros((2 * half + SHARED, 2 * half + SHARED)), np.zeros(2 * half + SHARED)
    sure[:half, :half], sure[half : 2 * half, half : 2 * half] = np.eye(3) * 0.004**2, np.eye(3) * 0.05**2
    alive = np.ones(1, dtype=bool)
    before = State(start_s, np.concatenate([PLACE, x[half:]]), sure, np.ones(1), alive)
    start = State(end_s, np.concatenate([moved, x[half:]]), 0.1 * sure, np.ones(1), alive)
    monkeypatch.setattr("rhot_fusion.filter.smoothing.smoother._BRIDGE_SCALE", 0.1)
    led = bridged(before, 0, start)
    assert np.abs(led.mean[0] - moved).max() < 0.02
    assert np.linalg.eigvalsh(led.P[:6, :6]).min() > 0.0
    late = replace(start, t_s=start_s + 0.5)
    assert bridged(before, 0, late) is before
    on_ray = replace(start, P=1000.0 * start.P)
    assert bridged(before, 0, on_ray) is before


def test_covariances_stay_positive_where_one_marker_starts_anew_among_others() -> None:
    """Depths that are hardly known before: what is removed of the marker's old state must not be subtracted twice."""
    places = PLACE + 0.08 * np.array([[0.0, 0.0, 0.0], [1.0, 0.2, 0.1], [-0.5, 1.0, -0.2]])
    wide = np.diag([1e-4, 1e-4, 1e-2, 1e-1, 1e-1, 1.0])
    frames: list[RecordedFrame] = []
    for number in range(16):
        camera = number % 2
        local = CAMERAS[camera].to_camera(places)
        variance = np.tile(ROUND[None] * (NOISE_PX / FOCAL_PX) ** 2, (3, 1))
        views = Views(CAMERAS[camera], np.arange(3), np.zeros(3), local[:, :2] / local[:, 2:], variance, np.zeros(3))
        starting = {0: (0, 1, 2), 6: (0,), 7: (0,)}.get(number, ())
        events = [
            Event(number * PERIOD_S, k, InitialState(np.concatenate([places[k], np.zeros(3)]), wide, 0.0), None)
            for k in starting
        ]
        nothing = np.zeros(3, dtype=bool)
        frames.append(RecordedFrame(number * PERIOD_S, camera, views, ~nothing, events, views.xy.copy(), np.zeros(3)))
    for node in smooth(frames, 3, CALIBRATED, as_they_are):
        assert np.linalg.eigvalsh(node.covariance).min() > 0.0
