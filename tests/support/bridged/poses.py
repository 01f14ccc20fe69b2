"""Known poses of a person above a floor, as messages of a rig that looks at them from anywhere."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Final

import numpy as np

from rhot.anatomy.hand import HandModel
from rhot.anatomy.skeleton import FINGERS, JOINTS
from rhot.arrays import FloatArray
from rhot.geometry.rotations import quaternion_from_rotation, rigid, rotation_x, rotation_y, rotation_z
from rhot.messages import HandPose, Joint, ObjectPose, Side, Space
from rhot.messages.base import wire_position, wire_quaternion
from rhot.rig import HandFile
from rhot_bridge.scene import BridgedHand, Scene, Thing

MODELS: Final[Mapping[Side, HandModel]] = {
    side: HandModel.from_file(HandFile(length_m=0.189), side) for side in ("left", "right")
}
POSES: Final = ("flat", "fist", "thumb up", "pointing")
T_RIG_STAGE: Final = rigid(rotation_z(0.3) @ rotation_x(2.2) @ rotation_y(-0.4), np.array([0.21, 0.43, 0.95]))
"""A camera that looks down at a desk at a slant."""


def angles(pose: str) -> FloatArray:
    """Finger angles (5, 4) of a named pose."""
    found = np.zeros((5, 4))
    curled = np.array([1.45, 0.0, 1.7, 1.1])
    if pose in ("fist", "thumb up"):
        found[1:] = curled
    if pose == "pointing":
        found[2:] = curled
    if pose in ("fist", "pointing"):
        found[0] = 0.6, 0.0, 0.6, 0.8
    return found


def wrist(pose: str, side: Side) -> FloatArray:
    """Wrist (4, 4) in stage axes: 1.1 m up, 0.4 m in front, 0.2 m to its side; palm down, but in `thumb up`.

    There the palm faces the other hand, so that the thumb points up.
    """
    sign = 1.0 if side == "right" else -1.0
    R = rotation_z(-sign * np.pi / 2) if pose == "thumb up" else np.eye(3)
    return rigid(R, np.array([0.2 * sign, 1.1, -0.4]))


def hand(pose: str, side: Side) -> BridgedHand:
    """A hand in stage axes."""
    model = MODELS[side]
    joints = model.forward(wrist(pose, side), angles(pose))
    return BridgedHand(
        10**18, "measured", 1.0, joints.positions, quaternion_from_rotation(joints.rotations), model.radii
    )


def thing(position: tuple[float, float, float], R: FloatArray | None = None) -> Thing:
    """A thing in stage axes."""
    quaternion = quaternion_from_rotation(np.eye(3) if R is None else R)
    return Thing(10**18, "measured", 1.0, np.array([position]), quaternion[None])


def scene(pose: str) -> Scene:
    """Both hands, head and feet of one person in stage axes."""
    return Scene(
        "stage",
        10**18,
        {side: hand(pose, side) for side in ("left", "right")},
        {"cube": thing((0.0, 0.75, -0.6))},
        thing((0.0, 1.6, -0.1)),
        {"left": thing((-0.1, 0.05, 0.0)), "right": thing((0.1, 0.05, 0.0))},
    )


def hand_message(pose: str, side: Side, t_ns: int, T_rig_stage: FloatArray = T_RIG_STAGE) -> HandPose:
    """The same hand as a rig publishes it."""
    model = MODELS[side]
    joints = model.forward(T_rig_stage @ wrist(pose, side), angles(pose))
    quaternions = quaternion_from_rotation(joints.rotations)
    return HandPose(
        t_ns=t_ns,
        side=side,
        frame="rig",
        joints={
            name: Joint(
                position=wire_position(joints.positions[row]),
                orientation=wire_quaternion(quaternions[row]),
                radius=float(model.radii[row]),
            )
            for row, name in enumerate(JOINTS)
        },
        angles={},
        residual={},
        fingers=dict.fromkeys(FINGERS, "measured"),
        state="measured",
    )


def object_message(t_ns: int, T_rig_stage: FloatArray = T_RIG_STAGE) -> ObjectPose:
    """The cube as a rig publishes it."""
    position = T_rig_stage[:3, :3] @ np.array([0.0, 0.75, -0.6]) + T_rig_stage[:3, 3]
    quaternion = quaternion_from_rotation(T_rig_stage[:3, :3])
    return ObjectPose(
        t_ns=t_ns,
        frame="rig",
        position=wire_position(position),
        orientation=wire_quaternion(quaternion),
        state="measured",
    )


def stage_message(t_ns: int, T_rig_stage: FloatArray = T_RIG_STAGE) -> Space:
    """The floor as a rig publishes it."""
    rows = [tuple(row) for row in T_rig_stage.tolist()]
    return Space(t_ns=t_ns, T_rig_space=(rows[0], rows[1], rows[2], rows[3]), source="test")


def row(joint: str) -> int:
    """Row of a joint."""
    return JOINTS.index(joint)
