from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from rhot.arrays import FloatArray
from rhot_objects.pose import Pose, angle_between, interpolate

METRES = st.floats(-10.0, 10.0)
POSES = st.builds(
    Pose.from_arrays,
    hnp.arrays(np.float64, 3, elements=METRES),
    hnp.arrays(np.float64, 4, elements=st.floats(-1.0, 1.0)).filter(lambda q: float(q @ q) > 1e-3),
)


def matrix(pose: Pose) -> FloatArray:
    """The 4x4 matrix by the textbook formula, independent of the code under test."""
    x, y, z, w = pose.orientation_xyzw
    T = np.eye(4)
    T[:3, :3] = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
        [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
        [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
    ]
    T[:3, 3] = pose.position
    return T


@settings(deadline=None, max_examples=60)
@given(POSES, POSES)
def test_composition_is_the_product_of_matrices(a: Pose, b: Pose) -> None:
    np.testing.assert_allclose(matrix(a @ b), matrix(a) @ matrix(b), atol=1e-9)


@settings(deadline=None, max_examples=60)
@given(POSES)
def test_inverse_undoes(pose: Pose) -> None:
    np.testing.assert_allclose(matrix(pose @ pose.inverse()), np.eye(4), atol=1e-9)
    np.testing.assert_allclose(matrix(pose.inverse()), np.linalg.inv(matrix(pose)), atol=1e-9)


@settings(deadline=None, max_examples=60)
@given(POSES)
def test_matrix_round_trip(pose: Pose) -> None:
    again = Pose.from_matrix(matrix(pose))
    np.testing.assert_allclose(again.position, pose.position)
    assert angle_between(again, pose) < 1e-7


@pytest.mark.parametrize(
    "diagonal", [(1.0, -1.0, -1.0), (-1.0, 1.0, -1.0), (-1.0, -1.0, 1.0)], ids=["about x", "about y", "about z"]
)
def test_half_turns_keep_their_axis(diagonal: tuple[float, float, float]) -> None:
    T = np.eye(4)
    T[:3, :3] = np.diag(diagonal)
    np.testing.assert_allclose(matrix(Pose.from_matrix(T)), T, atol=1e-12)


@pytest.mark.parametrize(
    "R",
    [np.zeros((3, 3)), 2.0 * np.eye(3), np.diag([1.0, 1.0, -1.0]), np.full((3, 3), np.nan)],
    ids=["zero", "scaled", "mirrored", "nan"],
)
def test_what_is_no_rotation_is_refused(R: FloatArray) -> None:
    with pytest.raises(ValueError, match="not a rotation"):
        Pose.from_matrix(np.hstack([R, np.zeros((3, 1))]))


@pytest.mark.parametrize("quaternion", [(0, 0, 0, 0), (np.nan, 0, 0, 1), (np.inf, 0, 0, 1), (0, 0, 0, 1e-12)])
def test_no_pose_without_a_quaternion(quaternion: tuple[float, float, float, float]) -> None:
    with pytest.raises(ValueError, match="not a pose"):
        Pose.from_arrays((0, 0, 0), quaternion)


@settings(deadline=None, max_examples=60)
@given(POSES, POSES, st.floats(0.0, 1.0))
def test_interpolation_moves_straight_and_turns_evenly_the_short_way(a: Pose, b: Pose, share: float) -> None:
    between = interpolate(a, b, share)
    whole = angle_between(a, b)
    np.testing.assert_allclose(between.position, a.position + share * (b.position - a.position), atol=1e-9)
    # Near half a turn both ways are the short one; either is right.
    assert angle_between(a, between) == pytest.approx(share * whole, abs=1e-5)
    assert angle_between(between, b) == pytest.approx((1.0 - share) * whole, abs=1e-5)


def test_interpolation_ignores_the_sign_of_the_quaternions() -> None:
    a = Pose.from_arrays((0, 0, 0), (0, 0, 0, 1))
    b = Pose.from_arrays((0, 0, 0), (0, 0, np.sin(0.2), np.cos(0.2)))
    flipped = Pose.from_arrays((0, 0, 0), -b.orientation_xyzw)
    assert angle_between(interpolate(a, flipped, 0.25), a) == pytest.approx(0.1, abs=1e-12)


def test_poses_cannot_be_changed() -> None:
    pose = Pose.from_arrays((1, 2, 3), (0, 0, 0, 1))
    with pytest.raises(ValueError, match="read-only"):
        pose.position[0] = 5.0
