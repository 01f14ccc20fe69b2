"""The pictures in the scene: the pixel that is pointed at is the pixel that the camera would see there."""

from __future__ import annotations

import numpy as np
import pytest

from rhot.geometry.rotations import rigid, rotation_from_vector
from rhot.rig.calibration import CameraCalibration, matrix4
from rhot.rig.cameras import camera_model
from rhot_viewer.scene.viewpoint import PICTURE_DISTANCE_M, PicturePlane

T = rigid(rotation_from_vector(np.array([0.2, -0.3, 0.5])), np.array([0.3, -0.1, 0.2]))
CAMERA = CameraCalibration(
    width=640, height=480, K=((520.0, 0.0, 300.0), (0.0, 510.0, 250.0), (0.0, 0.0, 1.0)), T_rig_camera=matrix4(T)
)
PLANE = PicturePlane.of(CAMERA)


def test_a_ray_meets_the_pixel_that_the_camera_sees() -> None:
    model = camera_model(CAMERA)
    rng = np.random.default_rng(4)
    pixels = rng.uniform((0.0, 0.0), (639.0, 479.0), (50, 2))
    for (u, v), direction in zip(pixels, model.rays(pixels), strict=True):
        assert PLANE.pixel_of_ray(model.center, 3.0 * direction) == pytest.approx((u, v), abs=1e-6)
        # From anywhere else, through the same place of the picture.
        on_plane = model.center + direction * PICTURE_DISTANCE_M / (direction @ T[:3, 2])
        eye = model.center + rng.normal(scale=0.3, size=3)
        assert PLANE.pixel_of_ray(eye, on_plane - eye) == pytest.approx((u, v), abs=1e-6)


def test_a_ray_that_misses_meets_nothing() -> None:
    to_picture = PLANE.center - PLANE.eye
    assert PLANE.pixel_of_ray(PLANE.eye, -to_picture) is None, "behind"
    assert PLANE.pixel_of_ray(PLANE.eye, PLANE.right) is None, "along the picture"
    assert PLANE.pixel_of_ray(PLANE.eye, to_picture + 330.0 * PLANE.right) is None, "beside"


def test_the_corners_span_the_whole_picture() -> None:
    model = camera_model(CAMERA)
    edges = [(-0.5, -0.5), (639.5, -0.5), (639.5, 479.5), (-0.5, 479.5)]
    assert model.project(PLANE.corners) == pytest.approx(np.array(edges), abs=1e-6)
    assert PLANE.size_m == pytest.approx((640 * PICTURE_DISTANCE_M / 520.0, 480 * PICTURE_DISTANCE_M / 510.0))
    assert PLANE.lines.shape == (8, 2, 3)
    assert PLANE.lines[4:, 0] == pytest.approx(np.tile(T[:3, 3], (4, 1)))
