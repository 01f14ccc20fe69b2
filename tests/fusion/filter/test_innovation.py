"""Innovations against the derivative taken numerically, and the noise of a view against what moves it."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from rhot.geometry.camera import CameraModel
from rhot.geometry.rotations import rotation_from_vector
from rhot_fusion.filter.innovation import Eye, innovate, pace

FloatArray = NDArray[np.float64]

STATE = np.array([0.05, -0.03, 0.7, 0.4, -0.2, 0.3])


@pytest.fixture
def camera() -> CameraModel:
    T = np.eye(4)
    T[:3, :3] = rotation_from_vector(np.array([0.1, -0.2, 0.05]))
    T[:3, 3] = 0.075, 0.01, -0.02
    return CameraModel.from_arrays(640, 480, np.diag([530.0, 530.0, 1.0]), np.zeros(0), T)


def seen(camera: CameraModel, place: FloatArray) -> FloatArray:
    x, y, z = camera.to_camera(place[None])[0]
    return np.array([x / z, y / z])


def test_covariances_are_those_of_the_projection(camera: CameraModel) -> None:
    rng = np.random.default_rng(0)
    root = rng.normal(0.0, 1e-3, (2, 6, 6))
    filters = np.zeros((1, 2, 7, 6))
    filters[0, :, :6] = root @ root.swapaxes(1, 2)
    filters[0, :, 6] = rng.normal(0.0, 1e-3, (2, 6))
    steps = 1e-6 * np.eye(3)
    H = np.array([seen(camera, STATE[:3] + d) - seen(camera, STATE[:3] - d) for d in steps]).T / 2e-6
    H = np.hstack([H, np.zeros((2, 3))])
    xy = seen(camera, STATE[:3]) + np.array([0.002, -0.001])
    V = np.array([[4e-8, 1e-8], [1e-8, 9e-8]])
    found = innovate([STATE.tolist()], filters, Eye.of(camera), [xy.tolist()], [(4e-8, 1e-8, 9e-8)])
    np.testing.assert_allclose(found.y[0], [0.002, -0.001], atol=1e-12)
    for k in range(2):
        P, d = filters[0, k, :6], filters[0, k, 6]
        np.testing.assert_allclose(found.B[0, k, :6], P @ H.T, atol=1e-12)
        np.testing.assert_allclose(found.B[0, k, 6], H @ d - [0.002, -0.001], atol=1e-9)
        np.testing.assert_allclose(found.S[0, k], H @ P @ H.T + V, atol=1e-12)
        assert found.det[0, k] == pytest.approx(np.linalg.det(found.S[0, k]))


def test_a_marker_behind_the_camera_is_far_from_expected(camera: CameraModel) -> None:
    behind = [0.05, -0.03, -0.7, 0.0, 0.0, 0.0]
    found = innovate([behind], np.zeros((1, 1, 7, 6)), Eye.of(camera), [[0.1, 0.0]], [(1e-8, 0.0, 1e-8)])
    assert np.isfinite(found.y).all()
    assert np.abs(found.y).max() > 1.0


def test_pace_of_a_marker_that_stays_as_far(camera: CameraModel) -> None:
    """Motion across the view: of the rotated camera too it is the derivative of what it sees, to its few degrees."""
    state = np.array([0.0, 0.0, 0.7, 0.4, -0.2, 0.0])
    moved = (seen(camera, state[:3] + 1e-4 * state[3:]) - seen(camera, state[:3] - 1e-4 * state[3:])) / 2e-4
    np.testing.assert_allclose(pace(Eye.of(camera), state.tolist()), moved, atol=0.2 * float(np.hypot(*moved)))
