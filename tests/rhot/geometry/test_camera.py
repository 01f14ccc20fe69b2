from __future__ import annotations

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from rhot.arrays import FloatArray
from rhot.geometry.camera import CameraModel

# Distortions as real modules have them: five coefficients, and the rational model of the 2018 rig's right camera.
DISTORTIONS = {
    "none": np.zeros(0),
    "brown": np.array([0.19, -0.48, 0.001, -0.0007, 0.30]),
    "rational": np.array([0.2647, -0.6959, 0.0, 0.0, 0.0, 0.0, 0.0, -0.6575]),
}


def rotation(axis_angle: FloatArray) -> FloatArray:
    """Rodrigues' formula, written out so that the test does not lean on the library under test."""
    angle = float(np.linalg.norm(axis_angle))
    if angle < 1e-12:
        return np.eye(3)
    x, y, z = axis_angle / angle
    K = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    R: FloatArray = np.eye(3) + np.sin(angle) * K + (1.0 - np.cos(angle)) * K @ K
    return R


def model(distortion: str, axis_angle: FloatArray, center: FloatArray) -> CameraModel:
    T = np.eye(4)
    T[:3, :3] = rotation(axis_angle)
    T[:3, 3] = center
    K = np.array([[512.5, 0.0, 324.9], [0.0, 511.3, 247.0], [0.0, 0.0, 1.0]])
    return CameraModel.from_arrays(640, 480, K, DISTORTIONS[distortion], T)


poses = st.tuples(*[st.floats(-0.6, 0.6)] * 3, *[st.floats(-1.0, 1.0)] * 3)
pixels = st.tuples(st.floats(20.0, 620.0), st.floats(20.0, 460.0))


@settings(deadline=None, max_examples=60)
@given(name=st.sampled_from(sorted(DISTORTIONS)), pose=poses, pixel=pixels, distance_m=st.floats(0.2, 3.0))
def test_projection_inverts_the_ray_of_a_pixel(
    name: str, pose: tuple[float, ...], pixel: tuple[float, float], distance_m: float
) -> None:
    camera = model(name, np.array(pose[:3]), np.array(pose[3:]))
    uv = np.array([pixel])
    point = camera.center + distance_m * camera.rays(uv)
    np.testing.assert_allclose(camera.project(point), uv, atol=1e-4)


@settings(deadline=None, max_examples=40)
@given(name=st.sampled_from(sorted(DISTORTIONS)), x=st.floats(-0.5, 0.5), y=st.floats(-0.38, 0.38))
def test_undistortion_inverts_distortion(name: str, x: float, y: float) -> None:
    camera = model(name, np.zeros(3), np.zeros(3))
    uv = camera.project(np.array([[x, y, 1.0]]))
    np.testing.assert_allclose(camera.undistort(uv), [[x, y]], atol=1e-7)


@settings(deadline=None, max_examples=40)
@given(pose=poses)
def test_pose_comes_back_from_the_model(pose: tuple[float, ...]) -> None:
    R, center = rotation(np.array(pose[:3])), np.array(pose[3:])
    camera = model("none", np.array(pose[:3]), center)
    np.testing.assert_allclose(camera.T_rig_camera[:3, :3], R, atol=1e-12)
    np.testing.assert_allclose(camera.to_camera(center[None]), 0.0, atol=1e-12)
    ahead = (center + R @ np.array([0.0, 0.0, 2.0]))[None]
    np.testing.assert_allclose(camera.to_camera(ahead), [[0.0, 0.0, 2.0]], atol=1e-12)


@pytest.mark.parametrize("count", [4, 5, 8, 12])
def test_lens_bends_as_opencv_says(count: int) -> None:
    rng = np.random.default_rng(count)
    distortion = rng.uniform(-0.2, 0.2, count)
    K = np.array([[512.5, 0.0, 324.9], [0.0, 511.3, 247.0], [0.0, 0.0, 1.0]])
    camera = CameraModel.from_arrays(640, 480, K, distortion, np.eye(4))
    points = rng.uniform((-0.4, -0.3, 0.5), (0.4, 0.3, 1.5), (50, 3))
    theirs, _ = cv2.projectPoints(points, np.zeros(3), np.zeros(3), K, distortion)
    np.testing.assert_allclose(camera.project(points), theirs.reshape(-1, 2), atol=1e-9)


def test_pinhole_by_hand() -> None:
    camera = model("none", np.zeros(3), np.zeros(3))
    np.testing.assert_allclose(
        camera.project(np.array([[0.1, -0.05, 0.5]])), [[324.9 + 102.5, 247.0 - 51.13]], atol=1e-9
    )


@pytest.mark.parametrize("distortion", ["none", "brown"])
def test_point_behind_the_camera_has_no_pixel(distortion: str) -> None:
    camera = model(distortion, np.zeros(3), np.zeros(3))
    uv = camera.project(np.array([[0.0, 0.0, -1.0], [0.0, 0.0, 0.0], [0.0, 0.0, 1.0]]))
    assert np.isnan(uv[:2]).all()
    assert np.isfinite(uv[2]).all()


def test_picture_ends_half_a_pixel_beyond_the_outer_centres() -> None:
    camera = model("none", np.zeros(3), np.zeros(3))
    uv = np.array([[-0.49, 0.0], [-0.51, 0.0], [639.49, 479.49], [639.51, 0.0], [np.nan, 0.0]])
    assert camera.contains(uv).tolist() == [True, False, True, False, False]


def test_nothing_in_gives_nothing_out() -> None:
    camera = model("brown", np.zeros(3), np.zeros(3))
    assert camera.project(np.empty((0, 3))).shape == (0, 2)
    assert camera.undistort(np.empty((0, 2))).shape == (0, 2)


def test_arrays_are_read_only() -> None:
    camera = model("brown", np.zeros(3), np.zeros(3))
    with pytest.raises(ValueError, match="read-only"):
        camera.K[0, 0] = 1.0
