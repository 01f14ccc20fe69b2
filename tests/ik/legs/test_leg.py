"""One leg: lengths, reach, and a knee that never points backwards."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from rhot_ik.legs.hips import bend_leg

THIGH, SHANK = 0.43, 0.42
coordinate = st.floats(-1.5, 1.5)
vectors = st.tuples(coordinate, coordinate, coordinate).map(np.array)
directions = vectors.filter(lambda vector: bool(np.linalg.norm(vector) > 0.1))


def across(hinge: NDArray[np.float64], line: NDArray[np.float64]) -> float:
    length = float(np.linalg.norm(line))
    return float(np.linalg.norm(np.cross(hinge, line / length))) if length > 1e-6 else 1.0


@settings(max_examples=60)
@given(vectors, vectors, directions)
def test_bones_keep_their_lengths_and_the_knee_its_side(
    hip: NDArray[np.float64], ankle: NDArray[np.float64], hinge: NDArray[np.float64]
) -> None:
    if across(hinge, ankle - hip) < 0.05:
        return
    leg = bend_leg(hip, ankle, hinge, THIGH, SHANK)
    assert np.linalg.norm(leg.knee - leg.hip) == pytest.approx(THIGH, abs=1e-9)
    assert np.linalg.norm(leg.knee - leg.ankle) == pytest.approx(SHANK, abs=1e-9)
    assert 0.0 <= leg.knee_flexion_rad < np.pi
    line = leg.ankle - leg.hip
    front = np.cross(leg.R_thigh[:, 0], line)
    assert (leg.knee - leg.hip) @ front >= -1e-9
    assert leg.R_thigh[:, 0] @ hinge > 0.0
    for R in (leg.R_thigh, leg.R_shank):
        np.testing.assert_allclose(R.T @ R, np.eye(3), atol=1e-9)
        assert np.linalg.det(R) == pytest.approx(1.0)


def test_a_known_right_angle() -> None:
    leg = bend_leg(np.zeros(3), np.array([0.0, -SHANK, -THIGH]), np.array([1.0, 0.0, 0.0]), THIGH, SHANK)
    np.testing.assert_allclose(leg.knee, [0.0, 0.0, -THIGH], atol=1e-12)
    assert leg.knee_flexion_rad == pytest.approx(np.pi / 2)
    np.testing.assert_allclose(leg.R_shank, np.eye(3), atol=1e-12)


def test_an_ankle_out_of_reach_straightens_the_leg_towards_it() -> None:
    leg = bend_leg(np.zeros(3), np.array([0.0, -2.0, 0.0]), np.array([1.0, 0.0, 0.0]), THIGH, SHANK)
    np.testing.assert_allclose(leg.ankle, [0.0, -THIGH - SHANK, 0.0], atol=1e-12)
    assert leg.knee_flexion_rad == pytest.approx(0.0, abs=1e-6)


def test_an_ankle_at_the_hip_is_no_nan() -> None:
    leg = bend_leg(np.ones(3), np.ones(3), np.array([0.0, 0.0, 1.0]), THIGH, SHANK)
    assert np.isfinite([*leg.knee, *leg.ankle, leg.knee_flexion_rad]).all()
    assert leg.knee_flexion_rad < np.radians(155.0)
