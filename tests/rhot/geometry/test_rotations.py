from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from rhot.arrays import FloatArray
from rhot.geometry.covariances import inverse_covariance, squared_distance, squared_distances, symmetric_inverse
from rhot.geometry.rotations import (
    cross_matrix,
    nearest_rotation,
    orthonormal,
    quaternion_from_rotation,
    rotation_from_quaternion,
    rotation_from_vector,
    rotation_x,
    rotation_y,
    rotation_z,
    vector_from_rotation,
)

angle = st.one_of(st.floats(-3.1, 3.1), st.sampled_from([0.0, 1e-9, -1e-7, 1e-4]))
vector = st.tuples(angle, angle, angle).filter(lambda v: float(np.linalg.norm(v)) < np.pi - 1e-3)


def rotation_of(quaternion_xyzw: FloatArray) -> FloatArray:
    x, y, z, w = quaternion_xyzw
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
            [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
            [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
        ]
    )


@settings(deadline=None)
@given(v=vector)
def test_vector_and_rotation_invert_each_other(v: tuple[float, float, float]) -> None:
    R = rotation_from_vector(np.array(v))
    assert np.allclose(R @ R.T, np.eye(3), atol=1e-12)
    assert np.linalg.det(R) == pytest.approx(1.0)
    assert np.allclose(vector_from_rotation(R), v, atol=1e-7)


@settings(deadline=None)
@given(v=vector)
def test_quaternion_is_the_same_rotation(v: tuple[float, float, float]) -> None:
    R = rotation_from_vector(np.array(v))
    assert np.allclose(rotation_of(quaternion_from_rotation(R)), R, atol=1e-9)


@pytest.mark.parametrize("turn", [rotation_x(np.pi), rotation_y(np.pi), rotation_z(np.pi)])
def test_half_turns_have_unit_quaternions(turn: FloatArray) -> None:
    quaternion = quaternion_from_rotation(turn)
    assert np.linalg.norm(quaternion) == pytest.approx(1.0)
    assert np.allclose(rotation_of(quaternion), turn, atol=1e-9)


def test_axis_rotations_are_right_handed() -> None:
    x, y, z = np.eye(3)
    assert np.allclose(rotation_x(np.pi / 2) @ y, z)
    assert np.allclose(rotation_y(np.pi / 2) @ z, x)
    assert np.allclose(rotation_z(np.pi / 2) @ x, y)


def test_nearest_rotation_never_mirrors() -> None:
    rng = np.random.default_rng(0)
    for _ in range(50):
        R = nearest_rotation(rng.normal(size=(3, 3)))
        assert np.allclose(R @ R.T, np.eye(3))
        assert np.linalg.det(R) == pytest.approx(1.0)
    R = rotation_from_vector(np.array([0.3, -0.5, 0.2]))
    assert np.allclose(nearest_rotation(R + 1e-4 * rng.normal(size=(3, 3))), R, atol=1e-3)


@pytest.mark.parametrize("size", [0.0, 1e-9, 1e-5, 1e-3, 0.5, 1.5, 2.5, np.pi - 1e-7])
def test_single_rotations_agree_with_the_general_formulas(size: float) -> None:
    rng = np.random.default_rng(3)
    for _ in range(20):
        axis = rng.normal(size=3)
        vector = axis / np.linalg.norm(axis) * size
        R = rotation_from_vector(vector)
        assert np.allclose(R, Rotation.from_rotvec(vector).as_matrix(), atol=1e-12)
        assert np.allclose(vector_from_rotation(R), vector, atol=1e-7)
        assert np.allclose(quaternion_from_rotation(R), quaternion_from_rotation(R[None])[0], atol=1e-12)
        assert np.allclose(rotation_from_quaternion(quaternion_from_rotation(R)), R, atol=1e-12)
        assert np.allclose(cross_matrix(vector) @ axis[::-1], np.cross(vector, axis[::-1]), atol=1e-12)
        assert np.allclose(orthonormal(R + 1e-7 * rng.normal(size=(3, 3))) @ R.T, np.eye(3), atol=1e-6)
        M = R @ np.diag([1e-6, 1e-4, 3e-6]) @ R.T
        assert np.allclose(symmetric_inverse(M) @ M, np.eye(3), atol=1e-9)
        quaternion = 3.0 * rng.choice([-1.0, 1.0]) * quaternion_from_rotation(R)
        assert np.allclose(rotation_from_quaternion(quaternion), R, atol=1e-12)
        assert squared_distance(axis, M) == pytest.approx(float(axis @ np.linalg.solve(M, axis)), rel=1e-9)
        assert squared_distance(np.zeros(3), M) == 0.0
        assert squared_distances(np.array([axis, -2.0 * axis]), np.array([M, 4.0 * M])) == pytest.approx(
            [squared_distance(axis, M)] * 2, rel=1e-9
        )


@pytest.mark.parametrize("number", [1, 3, 21])
def test_a_covariance_times_its_inverse_is_one(number: int) -> None:
    A = np.random.default_rng(number).normal(size=(number, number))
    S = A @ A.T + 0.1 * np.eye(number)
    assert np.allclose(inverse_covariance(S) @ S, np.eye(number), atol=1e-9)


def test_a_matrix_that_rounding_has_made_indefinite_still_has_an_inverse() -> None:
    S = np.diag([1.0, 1.0, 1.0, -1e-12])
    assert np.allclose(inverse_covariance(S) @ S, np.eye(4))
