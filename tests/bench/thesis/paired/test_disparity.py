from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from marker_streams import Motion, models, truth_figures, watch

from rhot.errors import ConfigError
from rhot.rig import Rig
from rhot_bench.thesis.paired.marker_states import PixelViews, Prior
from rhot_bench.thesis.paired.tracker import DisparityLaw, depth_from_disparity, disparity_from_depth
from rhot_fusion.core import FusionCore

LAW = (4543.3, -1.035)


@settings(deadline=None)
@given(st.floats(0.15, 3.0))
def test_law_and_its_inverse(depth_m: float) -> None:
    depth = np.array([depth_m])
    np.testing.assert_allclose(depth_from_disparity(disparity_from_depth(depth, LAW), LAW), depth, rtol=1e-12)


def test_disparity_is_signed() -> None:
    depth = depth_from_disparity(np.array([40.0, 0.0, -40.0]), LAW)
    assert depth[0] == pytest.approx(0.01 * 4543.3 * 40.0**-1.035)
    assert np.isnan(depth[1:]).all()
    assert np.isnan(disparity_from_depth(np.array([-1.0, 0.0]), LAW)).all()


def test_law_gives_the_distances_of_the_thesis(thesis_rig: Path) -> None:
    table = np.loadtxt(thesis_rig / "depth_table.csv", delimiter=",", skiprows=1)
    distance_cm, left_x, right_x, disparity_px = table.T
    np.testing.assert_array_equal(right_x - left_x, disparity_px)
    depth_cm = depth_from_disparity(disparity_px, LAW) * 100.0
    # The thesis states 1 to 3 % after the correction; pixels were read as integers.
    error = np.abs(depth_cm / distance_cm - 1.0)
    assert error.max() < 0.03
    assert error.mean() < 0.015


def test_points_come_back_through_the_law(make_rig: Callable[..., Rig]) -> None:
    law = DisparityLaw(models(make_rig()), LAW)
    truth = np.array([[0.0, 0.0, 0.8], [0.1, -0.05, 0.6], [-0.2, 0.1, 1.1]])
    xy = law.project(truth)
    nothing = Prior(np.full((3, 3), np.nan), np.ones(3))
    solution = law.solve(PixelViews(xy, np.ones((2, 3), dtype=bool)), nothing, 1e-3)
    np.testing.assert_allclose(solution.position, truth, atol=1e-9)
    focal_px = models(make_rig())[0].K[0, 0]
    np.testing.assert_allclose(
        focal_px * (xy[0, :, 0] - xy[1, :, 0]), disparity_from_depth(truth[:, 2], LAW), rtol=1e-12
    )


@pytest.mark.parametrize("camera", [0, 1])
def test_single_view_takes_its_depth_from_the_prior(make_rig: Callable[..., Rig], camera: int) -> None:
    law = DisparityLaw(models(make_rig()), LAW)
    truth = np.array([[0.1, -0.05, 0.7]])
    used = np.zeros((2, 1), dtype=bool)
    used[camera] = True
    believed = Prior(truth + np.array([[0.02, 0.02, 0.0]]), np.array([0.05]))
    solution = law.solve(PixelViews(law.project(truth), used), believed, 1e-3)
    np.testing.assert_allclose(solution.position, truth, atol=1e-9)


@pytest.mark.parametrize("places", [{"left": 0.0, "right": 0.075}, {"right": 0.075, "left": 0.0}])
def test_either_order_of_the_cameras_works(make_rig: Callable[..., Rig], places: dict[str, float]) -> None:
    law = DisparityLaw(models(make_rig(places=places)), LAW)
    truth = np.array([[0.05, 0.0, 0.8]])
    nothing = Prior(np.full((1, 3), np.nan), np.ones(1))
    solution = law.solve(PixelViews(law.project(truth), np.ones((2, 1), dtype=bool)), nothing, 1e-3)
    np.testing.assert_allclose(solution.position, truth, atol=1e-9)


def test_negative_disparity_is_refused(make_rig: Callable[..., Rig]) -> None:
    law = DisparityLaw(models(make_rig()), LAW)
    xy = law.project(np.array([[0.0, 0.0, 0.8]]))[::-1]
    nothing = Prior(np.full((1, 3), np.nan), np.ones(1))
    solution = law.solve(PixelViews(xy, np.ones((2, 1), dtype=bool)), nothing, 1e-3)
    assert not solution.in_front.any()
    assert np.isnan(solution.position).all()


def test_cameras_without_baseline_are_refused(make_rig: Callable[..., Rig]) -> None:
    with pytest.raises(ConfigError, match=r"cameras is 0\.0 mm"):
        DisparityLaw(models(make_rig(places={"left": 0.0, "right": 0.0})), LAW)
    with pytest.raises(ConfigError, match="exponent must be negative"):
        DisparityLaw(models(make_rig()), (4543.3, 1.0))


def test_method_follows_a_moving_hand(make_rig: Callable[..., Rig]) -> None:
    # A pinhole pair of 75 mm has d = f·B / Z: stated as a law, the method is exact but for noise and motion.
    rig = make_rig(fusion=f'method = "disparity"\ndepth_law = [{0.075 * 530.3 * 100.0}, -1.0]')
    motion = Motion(frequency_hz=(0.35, 0.45, 0.25))
    figures = truth_figures(FusionCore(rig), motion, watch(rig, motion, 3.0))
    assert figures.median_mm < 3.5
    assert figures.measured > 0.99
