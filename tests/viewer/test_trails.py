"""The paths of fingertips."""

from __future__ import annotations

import numpy as np

from rhot_viewer.scene.drawn import Trails

STEP_NS = 50_000_000


def walked(steps: int, trails: Trails) -> None:
    for step in range(steps):
        trails.add(step * STEP_NS, {"a": (0.01 * step, 0.0, 0.0)})


def lengths_m(trails: Trails) -> list[float]:
    return [round(float(length), 6) for length in np.linalg.norm(trails.lines[:, 1] - trails.lines[:, 0], axis=1)]


def test_the_newest_places_are_joined() -> None:
    trails = Trails(["a", "b"], 0.5)
    walked(4, trails)
    assert lengths_m(trails) == [0.01] * 3 + [0.0] * 7 + [0.0] * 10
    assert trails.lines[0, 0, 0] == 0.03, "the newest first"
    walked(40, trails)
    assert lengths_m(trails)[:10] == [0.01] * 10


def test_faster_samples_are_thinned_out() -> None:
    trails = Trails(["a"], 0.5)
    added = [trails.add(tick * STEP_NS // 6, {"a": (0.0, 0.0, tick)}) for tick in range(13)]
    assert sum(added) == 3
    assert not trails.add(13 * STEP_NS, {"unknown": (0.0, 0.0, 0.0)})


def test_a_pause_or_a_step_back_in_time_breaks_the_path() -> None:
    for later_ns in (20 * STEP_NS, 0):
        trails = Trails(["a"], 0.5)
        walked(4, trails)
        trails.add(later_ns, {"a": (5.0, 0.0, 0.0)})
        assert sum(lengths_m(trails)) == 0.0
        assert trails.lines[0, 0, 0] == 5.0


def test_one_hand_is_forgotten_alone() -> None:
    trails = Trails(["a", "b"], 0.5)
    for step in range(3):
        trails.add(step * STEP_NS, {"a": (0.0, 0.1 * step, 0.0), "b": (0.1 * step, 0.0, 0.0)})
    trails.clear("a")
    assert sum(lengths_m(trails)[:10]) == 0.0
    assert sum(lengths_m(trails)[10:]) > 0.1


def test_colours_fade_into_the_background() -> None:
    colors = Trails(["a", "b"], 0.5).colors({"a": (200, 100, 0), "b": (0, 0, 0)}, (10, 10, 10))
    assert colors.shape == (20, 2, 3)
    assert colors[0, 0].tolist() == [200, 100, 0]
    assert colors[9, 1].tolist() == [10, 10, 10]
