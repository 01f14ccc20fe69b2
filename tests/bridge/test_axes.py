"""Axes: the laws of the conversions, and where left, up and forward go."""

from __future__ import annotations

import numpy as np
import pytest
from bridged import poses as bridge_poses
from hypothesis import given
from hypothesis import strategies as st

from rhot.geometry.rotations import inverse, quaternion_from_rotation, rotation_from_quaternion, rotation_from_vector
from rhot.messages import Side
from rhot_bridge.axes import Converter, unity_euler_deg
from rhot_bridge.scene import BridgedHand, Scene, Thing, tracked

SIDES: tuple[Side, Side] = ("left", "right")
MIRROR = np.diag([1.0, 1.0, -1.0])
ANGLE = st.floats(-3.1, 3.1)


def rig_scene(pose: str) -> Scene:
    hands: dict[Side, BridgedHand] = {}
    for side in SIDES:
        hand = tracked(bridge_poses.hand_message(pose, side, 1))
        assert isinstance(hand, BridgedHand)
        hands[side] = hand
    cube = tracked(bridge_poses.object_message(1))
    assert isinstance(cube, Thing)
    return Scene("rig", 1, hands, {"cube": cube})


def test_the_stage_undoes_where_the_camera_stands() -> None:
    scene = Converter("stage", bridge_poses.T_RIG_STAGE).scene(rig_scene("pointing"))
    for side in SIDES:
        wanted = bridge_poses.hand("pointing", side)
        assert np.abs(scene.hands[side].positions - wanted.positions).max() < 1e-9
        ours, theirs = (rotation_from_quaternion(each.orientations) for each in (scene.hands[side], wanted))
        assert np.abs(ours - theirs).max() < 1e-6
    assert scene.objects["cube"].positions[0] == pytest.approx([0.0, 0.75, -0.6], abs=1e-9)


def test_unity_is_the_stage_in_a_mirror() -> None:
    stage, unity = (Converter(axes, bridge_poses.T_RIG_STAGE).scene(rig_scene("fist")) for axes in ("stage", "unity"))
    left, mirrored = stage.hands["left"], unity.hands["left"]
    assert np.allclose(mirrored.positions, left.positions @ MIRROR, atol=1e-9)
    ours, theirs = (rotation_from_quaternion(each.orientations) for each in (mirrored, left))
    assert np.allclose(ours, MIRROR @ theirs @ MIRROR, atol=1e-6)


def test_a_finger_points_along_unitys_forward() -> None:
    unity = Converter("unity", bridge_poses.T_RIG_STAGE).scene(rig_scene("flat"))
    hand = unity.hands["right"]
    forward = rotation_from_quaternion(hand.orientations[bridge_poses.row("index_proximal")])[:, 2]
    bone = hand.positions[bridge_poses.row("index_intermediate")] - hand.positions[bridge_poses.row("index_proximal")]
    assert forward @ bone / np.linalg.norm(bone) > 0.9999


def test_the_rigs_axes_stay_as_they_are() -> None:
    scene = rig_scene("flat")
    same = Converter("rig").scene(scene)
    assert np.array_equal(same.hands["left"].positions, scene.hands["left"].positions)
    with pytest.raises(ValueError, match="need T_rig_stage"):
        Converter("stage")


@given(x=ANGLE, y=ANGLE, z=ANGLE)
def test_the_inverse_of_a_rigid_conversion_keeps_distances(x: float, y: float, z: float) -> None:
    T = inverse(bridge_poses.T_RIG_STAGE)
    T[:3, :3] = rotation_from_vector(np.array([x, y, z]))
    hand = bridge_poses.hand("fist", "left")
    for axes in ("stage", "unity"):
        moved = Converter(axes, T).poses(hand)
        before, after = (np.linalg.norm(np.diff(each.positions, axis=0), axis=1) for each in (hand, moved))
        assert np.allclose(before, after, atol=1e-9)


def about(axis: int, degrees: float) -> np.ndarray:
    vector = np.zeros(3)
    vector[axis] = np.radians(degrees)
    return rotation_from_vector(vector)


@given(x=st.floats(-89.0, 89.0), y=st.floats(-179.0, 179.0), z=st.floats(-179.0, 179.0))
def test_euler_angles_are_applied_z_then_x_then_y(x: float, y: float, z: float) -> None:
    R = about(1, y) @ about(0, x) @ about(2, z)
    assert unity_euler_deg(quaternion_from_rotation(R)) == pytest.approx([x, y, z], abs=1e-3)


@pytest.mark.parametrize("x", [90.0, -90.0])
def test_euler_angles_in_gimbal_lock_give_the_same_rotation(x: float) -> None:
    R = about(1, 40.0) @ about(0, x) @ about(2, 25.0)
    ex, ey, ez = unity_euler_deg(quaternion_from_rotation(R))
    assert np.allclose(about(1, ey) @ about(0, ex) @ about(2, ez), R, atol=1e-3)
