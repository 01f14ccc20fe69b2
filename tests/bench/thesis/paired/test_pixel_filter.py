"""The 1-euro filter on views, and what it does to points, beside the one on points."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
from marker_streams import EPOCH_NS, MARKERS, Motion, Seen, pinhole_cameras, truth_figures, watch

from rhot.messages import PointSet
from rhot.rig import FusionConfig, Rig
from rhot_bench.thesis.paired.one_euro import PairedConfig
from rhot_bench.thesis.paired.tracker import PixelFilters
from rhot_fusion.core import FusionCore

MakeRig = Callable[..., Rig]
PIXELS = PairedConfig.of(FusionConfig(method="triangulate", options={"one_euro": "pixels"}))
STILL = Motion(amplitude_m=(0.0, 0.0, 0.0))
FAST_RATE = 10.0


def test_each_camera_and_marker_has_its_own_filter() -> None:
    filters = PixelFilters([500.0, 500.0], 3, PIXELS)
    both, one = np.array([0, 2]), np.array([2])
    filters.smoothed(0, both, np.array([0.0, 0.0]), np.array([[0.1, 0.2], [0.3, 0.4]]), FAST_RATE)
    later = filters.smoothed(0, one, np.array([0.02]), np.array([[0.301, 0.4]]), FAST_RATE)
    assert 0.3 < later[0, 0] < 0.301
    # The first view of the other camera is not filtered.
    first = filters.smoothed(1, one, np.array([0.02]), np.array([[0.9, 0.4]]), FAST_RATE)
    assert first.tolist() == [[0.9, 0.4]]


def test_rows_have_their_own_times() -> None:
    filters = PixelFilters([500.0], 2, PIXELS)
    markers = np.array([0, 1])
    filters.smoothed(0, markers, np.array([0.0, 0.010]), np.zeros((2, 2)), FAST_RATE)
    after = filters.smoothed(0, markers, np.array([0.02, 0.02]), np.full((2, 2), 1e-3), FAST_RATE)
    assert after[0, 0] > after[1, 0] > 0.0


def test_a_jump_is_not_smeared() -> None:
    filters = PixelFilters([500.0], 1, PIXELS)
    marker = np.array([0])
    filters.smoothed(0, marker, np.array([0.0]), np.zeros((1, 2)), 1.0)
    assert filters.smoothed(0, marker, np.array([0.02]), np.array([[0.5, 0.0]]), 1.0).tolist() == [[0.5, 0.0]]


def test_switched_off_it_changes_nothing_and_forgets() -> None:
    off = PairedConfig.of(FusionConfig(method="triangulate"))
    filters = PixelFilters([500.0], 1, off)
    marker, views = np.array([0]), np.array([[0.1, 0.2]])
    assert filters.smoothed(0, marker, np.array([0.0]), views, FAST_RATE) is views
    filters.configure(PIXELS)
    assert filters.smoothed(0, marker, np.array([0.02]), views, FAST_RATE).tolist() == views.tolist()


def jitter_mm(core: FusionCore, seen: list[Seen]) -> np.ndarray[tuple[int], np.dtype[np.float64]]:
    """Standard deviations x, y, z of still markers after a second, averaged."""
    found: dict[str, list[object]] = {name: [] for name in MARKERS}
    for one in seen:
        for _, points in core.feed(one.frame):
            assert isinstance(points, PointSet)
            if points.t_ns > EPOCH_NS + 700_000_000:
                for name, point in points.points.items():
                    found[name].append(point.position)
    mean: np.ndarray[tuple[int], np.dtype[np.float64]] = 1e3 * np.mean(
        [np.std(np.array(each, dtype=np.float64), axis=0) for each in found.values()], axis=0
    )
    return mean


@pytest.mark.parametrize("method", ["triangulate", "disparity"])
def test_a_still_hand_is_quieter_than_with_the_filter_on_points(make_rig: MakeRig, method: str) -> None:
    rig = make_rig(fusion=f'method = "{method}"')
    seen = watch(rig, STILL, 2.0)
    points, pixels = FusionCore(rig), FusionCore(rig)
    pixels.configure(FusionConfig.model_validate({"method": method, "one_euro": "pixels"}))
    before, after = jitter_mm(points, seen), jitter_mm(pixels, seen)
    # Measured over seeds: 0.65 sideways, 0.77 in depth.
    assert after[:2].mean() < 0.8 * before[:2].mean()
    assert after[2] < 0.95 * before[2]


def test_a_moving_hand_does_not_lag(make_rig: MakeRig) -> None:
    rig = make_rig(pinhole_cameras(2), fusion='method = "triangulate"\none_euro = "pixels"')
    motion = Motion()
    figures = truth_figures(FusionCore(rig), motion, watch(rig, motion, 2.0))
    assert figures.median_mm < 3.5
    assert figures.lateral_mm < 1.2
