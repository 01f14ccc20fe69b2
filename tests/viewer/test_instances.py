"""Copies of unit meshes: where they stand, and that the meshes are closed and seen from outside."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from rhot.geometry.rotations import rotation_from_quaternion
from rhot_viewer.scene.instances import Instances, Mesh, balls, rods, rotation_of_z, unit_ball, unit_box, unit_rod

RNG = np.random.default_rng(3)


def placed(mesh: Mesh, copies: Instances, row: int) -> NDArray[np.float64]:
    R = rotation_from_quaternion(np.roll(copies.wxyzs[row].astype(np.float64), -1))
    return np.asarray((mesh.vertices * copies.scales[row]) @ R.T + copies.positions[row])


def signed_volume(mesh: Mesh) -> float:
    a, b, c = np.moveaxis(mesh.vertices[mesh.faces].astype(np.float64), 1, 0)
    return float(np.einsum("ni,ni->n", a, np.cross(b, c)).sum() / 6.0)


def test_meshes_face_outwards() -> None:
    assert signed_volume(unit_box()) == pytest.approx(1.0)
    assert signed_volume(unit_ball(24, 48)) == pytest.approx(4.0 / 3.0 * np.pi, rel=0.02)
    assert signed_volume(unit_rod(48)) == pytest.approx(np.pi * 2.0 / 3.0, rel=0.02), "an open tube: its mantle's share"


def test_a_rod_reaches_from_end_to_end() -> None:
    starts, ends = RNG.normal(size=(20, 3)), RNG.normal(size=(20, 3))
    ends[0] = starts[0] - (0.0, 0.0, 0.4)  # straight down, where the half-way quaternion vanishes
    radii = RNG.uniform(0.005, 0.02, 20)
    copies = rods(starts, ends, radii, np.zeros((20, 3)))
    for row in range(20):
        vertices = placed(unit_rod(), copies, row)
        first, last = vertices[: len(vertices) // 2], vertices[len(vertices) // 2 :]
        assert np.linalg.norm(first.mean(axis=0) - starts[row]) < 2e-5
        assert np.linalg.norm(last.mean(axis=0) - ends[row]) < 2e-5
        assert np.linalg.norm(first - starts[row], axis=1) == pytest.approx(radii[row], abs=1e-5)


def test_a_ball_has_its_radius() -> None:
    copies = balls(np.array([[0.1, 0.2, 0.3]]), np.array([0.009]), [(1, 2, 3)])
    distances = np.linalg.norm(placed(unit_ball(), copies, 0) - (0.1, 0.2, 0.3), axis=1)
    assert distances == pytest.approx(0.009, abs=1e-6)


def test_a_direction_without_length_turns_nothing() -> None:
    assert rotation_of_z(np.zeros((1, 3))).tolist() == [[1.0, 0.0, 0.0, 0.0]]


def test_a_trembling_length_is_sent_as_one() -> None:
    lengths = [rods(np.zeros((1, 3)), np.array([[0.03 + d, 0, 0]]), np.array([0.01]), [(0, 0, 0)]) for d in (0, 1e-7)]
    assert np.array_equal(lengths[0].scales, lengths[1].scales)
