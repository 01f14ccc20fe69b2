from __future__ import annotations

import numpy as np
import pytest
from marker_scenes import SIZE_M, depth_camera, depth_image, plane_depths, tilted
from numpy.typing import NDArray

from rhot.geometry.rotations import vector_from_rotation
from rhot_feet.depth.plane import DepthPlane, fit_depth_plane
from rhot_feet.marker.pose import MarkerPose, marker_poses, square_corners, view_square

CAMERA = depth_camera()
RANGE = (0.3, 4.0)
Float = NDArray[np.float64]


def looks(
    z: float, tilt_deg: float, seed: int, noise_px: float = 0.15
) -> tuple[Float, Float, tuple[MarkerPose, ...], tuple[MarkerPose, ...]]:
    """A marker at random: its truth, and its poses without and with depth."""
    rng = np.random.default_rng(seed)
    R = tilted(tilt_deg, rng.uniform(0, 6.28), rng.uniform(-0.5, 0.5))
    t = np.array([rng.uniform(-0.2, 0.2), rng.uniform(-0.15, 0.15), z])
    corners = CAMERA.project(square_corners(SIZE_M) @ R.T + t) + rng.normal(0.0, noise_px, (4, 2))
    view = view_square(corners, SIZE_M, CAMERA, noise_px)
    plane = fit_depth_plane(depth_image(plane_depths(CAMERA, R[:, 2], t), seed), corners, CAMERA, RANGE)
    assert view is not None
    assert plane is not None
    return R, t, marker_poses(view), marker_poses(view, plane)


def error(pose: MarkerPose, R: Float, t: Float) -> Float:
    return np.concatenate([vector_from_rotation(pose.R_camera_marker @ R.T), pose.t_camera_marker - t])


@pytest.mark.parametrize(("z", "tilt_deg"), [(0.8, 25.0), (1.4, 25.0), (1.4, 45.0)])
def test_depth_makes_places_surer_and_covariances_are_honest(z: float, tilt_deg: float) -> None:
    alone, both, normalised = [], [], []
    for seed in range(20):
        R, t, without, with_depth = looks(z, tilt_deg, seed)
        alone.append(error(without[0], R, t)[3:])
        nearest = min(with_depth, key=lambda pose: float(np.linalg.norm(error(pose, R, t)[:3])))
        e = error(nearest, R, t)
        both.append(e[3:])
        normalised.append(float(e @ np.linalg.solve(nearest.covariance, e)) / 6.0)
    rms_alone, rms_both = (1e3 * float(np.sqrt(np.mean(np.sum(np.square(e), axis=1)))) for e in (alone, both))
    assert rms_both < 0.7 * rms_alone
    assert rms_both < 6.0
    assert 0.25 < float(np.mean(normalised)) < 2.0


def test_depth_tells_the_two_solutions_apart() -> None:
    without = with_depth = 0
    for seed in range(20):
        R, t, corners_only, depth = looks(1.4, 25.0, seed, 0.5)
        without += float(np.linalg.norm(error(corners_only[0], R, t)[:3])) < 0.25
        with_depth += float(np.linalg.norm(error(depth[0], R, t)[:3])) < 0.25
    assert with_depth >= 19
    assert without <= 17


def test_corners_in_no_order_of_a_square_give_nothing_or_something_finite() -> None:
    line = np.array([[100.0, 100.0], [150.0, 100.0], [200.0, 100.0], [250.0, 100.0]])
    view = view_square(line, SIZE_M, CAMERA)
    poses = () if view is None else marker_poses(view)
    assert all(np.isfinite(pose.t_camera_marker).all() for pose in poses)


def test_too_little_depth_is_no_plane() -> None:
    corners = np.array([[300.0, 200.0], [330.0, 200.0], [330.0, 230.0], [300.0, 230.0]])
    depth = np.zeros((480, 848), np.uint16)
    assert fit_depth_plane(depth, corners, CAMERA, RANGE) is None
    depth[205:207, 305:308] = 1000
    assert fit_depth_plane(depth, corners, CAMERA, RANGE) is None
    outside = corners + np.array([900.0, 0.0])
    assert fit_depth_plane(np.full((480, 848), 1000, np.uint16), outside, CAMERA, RANGE) is None


def test_a_plane_is_fitted_through_outliers() -> None:
    R, t = tilted(20.0, 1.0), np.array([0.05, 0.0, 1.2])
    corners = CAMERA.project(square_corners(SIZE_M) @ R.T + t)
    depth = depth_image(plane_depths(CAMERA, R[:, 2], t))
    u, v = corners.mean(axis=0).astype(int)
    depth[v : v + 5, u - 12 : u - 2] = 700
    plane = fit_depth_plane(depth, corners, CAMERA, RANGE)
    assert isinstance(plane, DepthPlane)
    assert abs(plane.depth_m(t[:2] / t[2]) - 1.2) < 0.008
