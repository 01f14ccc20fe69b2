"""Head, feet and body of a person on a known floor, as messages of a rig that looks at them from anywhere."""

from __future__ import annotations

from typing import Final

import numpy as np

from rhot.arrays import FloatArray
from rhot.geometry.rotations import quaternion_from_rotation, rigid, rotation_x
from rhot.messages import BodyJoint, BodyPose, FootPose, HeadPose, LegAngles, Side
from rhot.messages.base import Position, Quaternion, wire_position, wire_quaternion

BEGIN_NS: Final = 1_800_000_000_123_456_789
RATE_HZ: Final = 60.0
SECONDS_A_POSE: Final = 0.5
KNEE_RAD: Final = 0.4
"""Both knees are bent by so much: the shank leans back."""

HEAD: Final = (0.0, 1.6, -0.1)
FEET: Final[dict[Side, tuple[float, float, float]]] = {"left": (-0.1, 0.05, 0.0), "right": (0.1, 0.05, 0.0)}
JOINTS: Final[dict[str, tuple[float, float, float]]] = {
    "hips": (0.0, 0.95, 0.0),
    "spine_lower": (0.0, 1.03, 0.01),
    "chest": (0.0, 1.22, 0.02),
    "neck": (0.0, 1.46, -0.02),
    "head": (0.0, 1.55, -0.03),
    "right_shoulder": (0.2, 1.38, -0.01),
    "right_elbow": (0.25, 1.1, 0.05),
    "right_wrist": (0.22, 1.05, -0.2),
    "left_hip": (-0.09, 0.9, 0.0),
    "left_knee": (-0.09, 0.5, 0.0),
    "left_ankle": (-0.09, 0.08, 0.17),
    "left_foot": (-0.09, 0.02, 0.04),
    "right_hip": (0.09, 0.9, 0.0),
    "right_knee": (0.09, 0.5, 0.0),
    "right_ankle": (0.09, 0.08, 0.17),
    "right_foot": (0.09, 0.02, 0.04),
}
"""Metres, stage axes."""


def placed(
    position: tuple[float, float, float], T_rig_stage: FloatArray, R: FloatArray | None = None
) -> tuple[Position, Quaternion]:
    """Return where a pose of the stage is in the rig frame."""
    T = T_rig_stage @ rigid(np.eye(3) if R is None else R, np.array(position))
    return wire_position(T[:3, 3]), wire_quaternion(quaternion_from_rotation(T[:3, :3]))


def head_message(t_ns: int, T_rig_stage: FloatArray) -> HeadPose:
    position, orientation = placed(HEAD, T_rig_stage)
    return HeadPose(t_ns=t_ns, frame="rig", position=position, orientation=orientation, state="measured")


def foot_message(side: Side, t_ns: int, T_rig_stage: FloatArray) -> FootPose:
    position, orientation = placed(FEET[side], T_rig_stage)
    return FootPose(
        t_ns=t_ns,
        side=side,
        frame="rig",
        position=position,
        orientation=orientation,
        velocity=(0.0, 0.0, 0.0),
        sigma=0.004,
        stage="marker",
        state="measured",
    )


def body_message(t_ns: int, T_rig_stage: FloatArray) -> BodyPose:
    joints = {}
    for name, position in JOINTS.items():
        R = rotation_x(KNEE_RAD) if name.endswith("_knee") else np.eye(3)
        in_rig, orientation = placed(position, T_rig_stage, R)
        joints[name] = BodyJoint(position=in_rig, orientation=orientation)
    leg = LegAngles(hip_flexion=0.1, hip_abduction=0.05, hip_rotation=0.02, knee_flexion=KNEE_RAD, ankle_flexion=-0.1)
    return BodyPose(
        t_ns=t_ns,
        frame="rig",
        joints=joints,
        angles={"left": leg, "right": leg},
        legs={"left": "measured", "right": "measured"},
        state="measured",
    )
