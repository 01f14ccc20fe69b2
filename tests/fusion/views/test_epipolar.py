from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
from marker_streams import models, pinhole_cameras

from rhot.arrays import FloatArray
from rhot.geometry.camera import CameraModel
from rhot.rig import Rig
from rhot.rig.cameras import camera_model
from rhot_bench.thesis.paired.marker_states import Triangulation
from rhot_fusion.views.epipolar import EpipolarModel

FOCAL_PX = 530.5


def observations(cameras: list[CameraModel], rng: np.random.Generator, count: int = 6) -> FloatArray:
    points = np.column_stack(
        [rng.uniform(-0.2, 0.25, count), rng.uniform(-0.2, 0.2, count), rng.uniform(0.6, 1.0, count)]
    )
    return Triangulation(cameras).project(points)


def rolled(xy: FloatArray, offset_px: float, roll_rad: float) -> FloatArray:
    """Move the second camera's rows by an offset and a roll."""
    moved = xy.copy()
    moved[1, :, 1] += offset_px / FOCAL_PX + roll_rad * xy[1, :, 0]
    return moved


def test_true_views_have_no_residual(make_rig: Callable[..., Rig]) -> None:
    for cameras in (models(make_rig()), [camera_model(one) for one in pinhole_cameras(4).values()]):
        model = EpipolarModel(cameras, 15.0)
        residual = model.residual(observations(cameras, np.random.default_rng(1)))
        assert np.isnan(residual[0]).all()
        np.testing.assert_allclose(residual[1:], 0.0, atol=1e-12)


def test_offset_and_roll_are_estimated_among_outliers(make_rig: Callable[..., Rig]) -> None:
    cameras = models(make_rig())
    rng = np.random.default_rng(2)
    model = EpipolarModel(cameras, 15.0)
    for _ in range(300):
        xy = rolled(observations(cameras, rng), -5.0, 0.0175)
        xy[1, :, 1] += rng.normal(0.0, 0.5 / FOCAL_PX, 6)
        if rng.random() < 0.3:
            xy[1, 0, 1] += 30.0 / FOCAL_PX
        model.learn(xy, np.ones((2, 6), dtype=bool), 1 / 30)
    clean = rolled(observations(cameras, rng), -5.0, 0.0175)
    remaining_px = model.residual(model.correct(clean))[1] * FOCAL_PX
    assert np.abs(remaining_px).max() < 0.4
    assert model.spread_px == pytest.approx(0.5, rel=0.4)
    mean, p95 = model.figures_px
    assert 0.3 < mean < 3.0
    assert p95 > mean


def test_correction_does_not_move_points_along_the_epipolar_line(make_rig: Callable[..., Rig]) -> None:
    cameras = models(make_rig())
    rng = np.random.default_rng(3)
    model = EpipolarModel(cameras, 15.0)
    for _ in range(100):
        model.learn(rolled(observations(cameras, rng), -5.0, 0.0), np.ones((2, 6), dtype=bool), 1 / 30)
    xy = rolled(observations(cameras, rng), -5.0, 0.0)
    corrected = model.correct(xy)
    np.testing.assert_allclose(corrected[:, :, 0], xy[:, :, 0], atol=1e-12)
    np.testing.assert_array_equal(corrected[0], xy[0])


def test_correction_is_bounded(make_rig: Callable[..., Rig]) -> None:
    cameras = models(make_rig())
    rng = np.random.default_rng(4)
    model = EpipolarModel(cameras, 4.0)
    for _ in range(200):
        model.learn(rolled(observations(cameras, rng), 12.0, 0.0), np.ones((2, 6), dtype=bool), 1 / 30)
    xy = observations(cameras, rng)
    moved_px = (model.correct(xy) - xy)[1] * FOCAL_PX
    assert np.abs(moved_px).max() == pytest.approx(4.0, rel=0.01)


def test_nothing_accepted_teaches_nothing(make_rig: Callable[..., Rig]) -> None:
    cameras = models(make_rig())
    model = EpipolarModel(cameras, 15.0)
    xy = rolled(observations(cameras, np.random.default_rng(5)), 9.0, 0.0)
    model.learn(xy, np.zeros((2, 6), dtype=bool), 1 / 30)
    assert (model.coefficients == 0.0).all()
    assert model.figures_px == (0.0, 0.0)
