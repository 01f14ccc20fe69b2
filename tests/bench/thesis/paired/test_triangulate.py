from __future__ import annotations

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st
from marker_streams import pinhole_cameras

from rhot.arrays import FloatArray
from rhot.geometry.camera import CameraModel
from rhot.rig.cameras import camera_model
from rhot_bench.thesis.paired.marker_states import PixelViews, Prior, Triangulation

DISTORTION = np.array([0.19, -0.48, 0.001, -0.0007, 0.30])
SIGMA = 1e-3


def cameras(count: int, distortion: FloatArray | None = None) -> list[CameraModel]:
    return [camera_model(camera) for camera in pinhole_cameras(count, distortion).values()]


def seen(models: list[CameraModel], points: FloatArray, noise_px: float = 0.0, seed: int = 0) -> FloatArray:
    rng = np.random.default_rng(seed)
    pixels = [model.project(points) for model in models]
    return np.stack(
        [model.undistort(uv + rng.normal(0.0, noise_px, uv.shape)) for model, uv in zip(models, pixels, strict=True)]
    )


def no_prior(count: int) -> Prior:
    return Prior(np.full((count, 3), np.nan), np.ones(count))


points = st.tuples(st.floats(-0.2, 0.25), st.floats(-0.2, 0.2), st.floats(0.45, 1.2))


@settings(deadline=None, max_examples=50)
@given(count=st.integers(2, 8), point=points, distorted=st.booleans())
def test_projection_and_triangulation_invert_each_other(
    count: int, point: tuple[float, float, float], distorted: bool
) -> None:
    models = cameras(count, DISTORTION if distorted else None)
    truth = np.array([point])
    xy = seen(models, truth)
    solution = Triangulation(models).solve(PixelViews(xy, np.isfinite(xy[:, :, 0])), no_prior(1), SIGMA)
    np.testing.assert_allclose(solution.position, truth, atol=1e-6)
    assert solution.in_front.all()
    assert solution.residual[0] < 1e-6


@settings(deadline=None, max_examples=30)
@given(count=st.integers(2, 5), point=points)
def test_projection_agrees_with_the_camera_model(count: int, point: tuple[float, float, float]) -> None:
    models = cameras(count, DISTORTION)
    truth = np.array([point])
    np.testing.assert_allclose(Triangulation(models).project(truth), seen(models, truth), atol=1e-7)


def test_each_point_uses_its_own_views() -> None:
    models = cameras(4)
    truth = np.array([[0.0, 0.0, 0.8], [0.1, 0.05, 0.7], [-0.1, 0.0, 0.9]])
    xy = seen(models, truth)
    used = np.array([[True, True, False], [True, False, True], [False, True, False], [False, True, False]])
    xy[~used] = np.nan
    solution = Triangulation(models).solve(PixelViews(xy, used), no_prior(3), SIGMA)
    np.testing.assert_allclose(solution.position[:2], truth[:2], atol=1e-6)
    assert np.isnan(solution.position[2]).all()


def test_covariance_is_the_scatter_of_noisy_solutions() -> None:
    models = cameras(2)
    truth = np.repeat([[0.02, 0.01, 0.8]], 3000, axis=0)
    focal_px = models[0].K[0, 0]
    xy = seen(models, truth, noise_px=0.3, seed=3)
    solution = Triangulation(models).solve(
        PixelViews(xy, np.ones((2, 3000), dtype=bool)), no_prior(3000), 0.3 / focal_px
    )
    scatter = np.sqrt(np.diag(np.cov((solution.position - truth).T)))
    stated = np.sqrt(np.diag(solution.covariance.mean(axis=0)))
    np.testing.assert_allclose(stated, scatter, rtol=0.06)
    # 75 mm of baseline at 0.8 m: depth is about fifteen times as noisy as the lateral place.
    assert 10.0 < stated[2] / stated[1] < 25.0


def test_more_views_lower_the_error() -> None:
    truth = np.repeat([[0.02, 0.01, 0.8]], 800, axis=0)
    errors = []
    for count in (2, 4, 8):
        models = cameras(count)
        xy = seen(models, truth, noise_px=0.3, seed=4)
        solution = Triangulation(models).solve(PixelViews(xy, np.ones((count, 800), dtype=bool)), no_prior(800), SIGMA)
        errors.append(float(np.median(np.linalg.norm(solution.position - truth, axis=1))) * 1e3)
    assert errors[0] > 1.5 * errors[1] > 2.0 * errors[2]
    assert errors[0] < 6.0


def test_single_view_keeps_the_prior_depth() -> None:
    models = cameras(2)
    truth = np.array([[0.05, -0.02, 0.8]])
    believed = truth + np.array([[0.01, 0.01, 0.0]])
    xy = seen(models, truth)
    used = np.array([[True], [False]])
    solution = Triangulation(models).solve(PixelViews(xy, used), Prior(believed, np.array([0.03])), SIGMA)
    # The point on the ray of the view nearest to the prior.
    reprojected = Triangulation(models).project(solution.position)[0]
    np.testing.assert_allclose(reprojected, xy[0], atol=1e-4)
    assert abs(solution.position[0, 2] - 0.8) < 2e-3
    assert np.sqrt(solution.covariance[0, 2, 2]) > 0.028


def test_swapped_cameras_put_points_behind_them() -> None:
    K = cameras(1)[0].K
    T = np.eye(4)
    T[0, 3] = 0.075
    parallel = [CameraModel.from_arrays(640, 480, K, np.zeros(0), pose) for pose in (np.eye(4), T)]
    xy = seen(parallel, np.array([[0.0, 0.0, 0.8]]))[::-1]
    solution = Triangulation(parallel).solve(PixelViews(xy, np.ones((2, 1), dtype=bool)), no_prior(1), SIGMA)
    assert not solution.in_front.any()
    assert np.isnan(solution.position).all()


def test_rays_that_meet_nowhere_are_no_error() -> None:
    one = cameras(1)[0]
    xy = np.zeros((2, 3, 2))
    xy[1, 1, 0] = 0.1
    xy[:, 2] = 1e5
    for baseline_m in (0.0, 0.075):
        T = np.eye(4)
        T[0, 3] = baseline_m
        pair = [one, CameraModel.from_arrays(640, 480, one.K, np.zeros(0), T)]
        solution = Triangulation(pair).solve(PixelViews(xy, np.ones((2, 3), dtype=bool)), no_prior(3), SIGMA)
        near = np.linalg.norm(np.nan_to_num(solution.position, nan=np.inf), axis=1) < 2.0
        assert not (near & (solution.residual < 0.01) & (np.trace(solution.covariance, axis1=1, axis2=2) < 0.1)).any()
