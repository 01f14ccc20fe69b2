from __future__ import annotations

import numpy as np
import pytest

from rhot.geometry.distance_grid import distance_grid

trimesh = pytest.importorskip("trimesh", reason="needs the extra `mesh`")

MAJOR, MINOR = 0.05, 0.01


def test_a_ring_keeps_its_hole() -> None:
    ring = trimesh.creation.torus(MAJOR, MINOR, major_sections=64, minor_sections=24)
    grid = distance_grid(np.array(ring.vertices), np.array(ring.faces))
    points = np.random.default_rng(1).uniform(-0.07, 0.07, (4000, 3)) * [1.0, 1.0, 0.4]
    round_m = np.hypot(points[:, 0], points[:, 1]) - MAJOR
    true = np.hypot(round_m, points[:, 2]) - MINOR
    distance, out = grid.distance(points)
    reached = np.abs(true) < 0.02
    assert np.abs(distance - true)[reached].max() < 0.0015
    assert np.median(np.abs(distance - true)) < 0.0002
    assert grid.distance(np.zeros((1, 3)))[0] == pytest.approx(MAJOR - MINOR, abs=0.001)
    # Along the way out the distance grows as fast as one walks.
    near = np.abs(true) < 0.005
    further, _ = grid.distance(points[near] + 0.002 * out[near])
    assert np.median(further - distance[near]) == pytest.approx(0.002, rel=0.05)


def test_beyond_the_grid_the_way_to_it_counts() -> None:
    box = trimesh.creation.box((0.1, 0.06, 0.02))
    grid = distance_grid(np.array(box.vertices), np.array(box.faces))
    distance, out = grid.distance(np.array([[0.5, 0.0, 0.0], [0.0, 0.0, -0.3]]))
    assert distance == pytest.approx([0.45, 0.29], abs=0.002)
    assert np.allclose(out, [[1.0, 0.0, 0.0], [0.0, 0.0, -1.0]], atol=1e-6)


def test_a_sheet_has_no_inside() -> None:
    corners = np.array([[0.0, 0.0, 0.0], [0.1, 0.0, 0.0], [0.1, 0.1, 0.0], [0.0, 0.1, 0.002]])
    grid = distance_grid(corners, np.array([[0, 1, 2], [0, 2, 3]]))
    distance, _ = grid.distance(np.array([[0.05, 0.05, 0.02], [0.05, 0.05, -0.02]]))
    assert distance == pytest.approx([0.02, 0.02], abs=0.002)
