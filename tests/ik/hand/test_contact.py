from __future__ import annotations

import numpy as np
import pytest

from rhot.geometry.rotations import rotation_from_vector
from rhot.messages import MeshShape
from rhot_ik.hand.contact import Box, Cylinder, Shape, Sphere
from rhot_ik.hand_core import body_of

CUBOID = MeshShape(
    file="brick.glb",
    size=(0.05, 0.08, 0.03),
    planes=tuple(
        (side * (axis == 0), side * (axis == 1), side * (axis == 2), half)
        for axis, half in enumerate((0.025, 0.04, 0.015))
        for side in (1.0, -1.0)
    ),
)
T = np.eye(4)
T[:3, :3], T[:3, 3] = rotation_from_vector(np.array([0.4, -0.3, 0.8])), [0.1, -0.05, 0.7]


@pytest.mark.parametrize(
    "shape", [Sphere(T[:3, 3], 0.03), Box(T, np.array([0.05, 0.08, 0.03])), Cylinder(T, 0.03, 0.07)]
)
def test_the_way_out_leads_to_the_surface(shape: Shape) -> None:
    points = T[:3, 3] + np.random.default_rng(1).normal(0.0, 0.03, (500, 3))
    distance, out = shape.distance(points)
    assert (distance < 0.0).any()
    assert (distance > 0.0).any()
    assert np.allclose(np.linalg.norm(out, axis=1), 1.0)
    left, _ = shape.distance(points - distance[:, None] * out)
    assert np.abs(left).max() < 1e-9
    # No point of the neighbourhood is nearer to the surface than the distance says.
    further, _ = shape.distance(points + 0.001 * out)
    assert np.allclose(further, distance + 0.001)


def test_a_mesh_is_met_at_its_planes() -> None:
    box, hull = Box(T, np.array([0.05, 0.08, 0.03])), body_of(CUBOID, T)
    points = T[:3, 3] + np.random.default_rng(2).normal(0.0, 0.03, (500, 3))
    (expected, way), (distance, out) = box.distance(points), hull.distance(points)
    local = np.abs((points - T[:3, 3]) @ T[:3, :3]) - 0.5 * box.size_m
    corner = (local > 0.0).all(axis=1)
    assert 10 < corner.sum() < 100
    assert np.allclose(distance[~corner], expected[~corner])
    assert np.allclose(out[~corner & (distance > 0.0)], way[~corner & (distance > 0.0)])
    # Beyond a corner: the distance to the nearest of its three edges' lines.
    two = np.sort(local[corner], axis=1)[:, 1:]
    assert np.allclose(distance[corner], np.hypot(two[:, 0], two[:, 1]))


def test_distances_of_a_box_are_known() -> None:
    box = Box(np.eye(4), np.array([0.2, 0.4, 0.6]))
    distance, out = box.distance(np.array([[0.15, 0.0, 0.0], [0.13, 0.24, 0.0], [0.0, 0.19, 0.0]]))
    assert np.allclose(distance, [0.05, 0.05, -0.01])
    assert np.allclose(out[2], [0.0, 1.0, 0.0])
