from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from rhot.anatomy.hand import MOVING, HandModel
from rhot.geometry.distance_grid import DistanceGrid
from rhot.geometry.rotations import rotation_from_vector
from rhot.messages import MeshShape
from rhot.rig import HandFile
from rhot_ik.hand.closed_form import FingerGeometry
from rhot_ik.hand.contact import Box, Cylinder, GraspContact, Hull, Shape, Solid, Sphere
from rhot_ik.hand.filter.filter import HandFilter
from rhot_ik.hand.filter.kinematics import HandKinematics
from rhot_ik.hand.filter.process import HandState, rest_angles
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


BAR_M, RING_M = 0.008, 0.05
MODEL = HandModel.from_file(HandFile(), "right")
LONG = np.array([False, True, True, True, True])


def hand_on_a_ring() -> tuple[HandFilter, HandKinematics, HandState, np.ndarray]:
    """Return a relaxed hand over the top of an upright ring whose bar runs along the knuckles, and the ring's pose."""
    geometry = FingerGeometry.of(MODEL, {})
    hand = HandFilter(geometry, np.zeros(3), np.zeros(6, dtype=bool))
    start = hand.start(np.eye(3), np.zeros(3), rest_angles(MODEL))
    top = MODEL.knuckles[1:].mean(axis=0) + np.array([0.0, -0.03, 0.005])
    T_ring = np.eye(4)
    T_ring[:3, 3] = top - [0.0, RING_M, 0.0]
    return hand, HandKinematics(geometry), start, T_ring


def ring_grid() -> DistanceGrid:
    """Return the distances of a ring about the z axis."""
    step = 0.002
    axes = [np.arange(-reach, reach + step, step) for reach in (0.07, 0.07, 0.02)]
    x, y, z = np.meshgrid(*axes, indexing="ij")
    return DistanceGrid(np.array([axis[0] for axis in axes]), step, np.hypot(np.hypot(x, y) - RING_M, z) - BAR_M)


def test_fingers_may_be_in_the_hole_of_a_ring_but_not_in_its_bar() -> None:
    hand, kinematics, start, T = hand_on_a_ring()
    contact, ring = GraspContact(MODEL, hand, kinematics), Solid(T, ring_grid())
    around = np.linspace(0.0, 2.0 * np.pi, 24, endpoint=False)
    rim = np.stack([np.cos(around), np.sin(around), 0.0 * around, np.full(24, RING_M + BAR_M)], axis=1)
    faces = np.array([[0.0, 0.0, 1.0, BAR_M], [0.0, 0.0, -1.0, BAR_M]])
    hull = Hull(T, np.concatenate([rim, faces]))
    angles = start.angles.reshape(5, 4).copy()
    angles[1:, 0], angles[1:, 2:] = np.radians(50.0), np.radians([60.0, 40.0])
    closed = dataclasses.replace(hand.predict(start, 1 / 60), angles=angles.reshape(-1))

    def moved(shape: Shape) -> float:
        """Return how far meeting a shape moves a finger's joint at most, degrees."""
        state = contact.corrected(closed, LONG, [shape], held=False)
        assert np.linalg.eigvalsh(state.P).min() > -1e-12
        return float(np.degrees(np.abs(state.angles - closed.angles)).max())

    assert moved(ring) < 3.0
    assert moved(hull) > 8.0


def test_a_finger_in_a_grasp_closes_until_its_last_bone_is_at_the_bar() -> None:
    hand, kinematics, state, T = hand_on_a_ring()
    contact, ring = GraspContact(MODEL, hand, kinematics), Solid(T, ring_grid())
    for _ in range(60):
        state = contact.corrected(hand.predict(state, 1 / 60, LONG, holds=True), LONG, [ring], held=True)
    joints, _ = kinematics.chains(state.angles, state.longer)
    last = joints[1:, 1:2] + np.linspace(0.0, 1.0, 9)[:, None] * (joints[1:, 2:] - joints[1:, 1:2])
    gap = (ring.distance((last.reshape(-1, 3)) @ state.R.T + state.p)[0]).reshape(4, 9) - MODEL.radii[MOVING[1:, 3:]]
    assert np.abs(gap.min(axis=1)).max() < 0.006


def test_what_is_near_is_not_what_is_held() -> None:
    hand, kinematics, state, T = hand_on_a_ring()
    contact, ring = GraspContact(MODEL, hand, kinematics), Solid(T, ring_grid())
    seen, tips = np.array([True, False, False, False, False]), np.zeros((5, 3))
    nothing = np.zeros(5, dtype=bool)
    assert contact.is_held(state, tips, nothing, [ring])
    assert not contact.is_held(state, tips, nothing, [])
    T_away = T.copy()
    T_away[:3, 3] += [0.0, -0.3, 0.0]
    assert not contact.is_held(state, tips, nothing, [Solid(T_away, ring_grid())])
    # The thumb is seen: at the bar, and far from it.
    tips[0] = T[:3, 3] + [0.0, RING_M + BAR_M + 0.012, 0.0]
    assert contact.is_held(state, tips, seen, [ring])
    tips[0] += [0.0, 0.05, 0.0]
    assert not contact.is_held(state, tips, seen, [ring])
