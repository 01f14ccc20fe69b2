"""How far each joint of a hand may bend, as fans of lines: what the filter and the chain solver obey.

A knuckle has two fans, one for flexion and one for abduction; each hinge has one. A fan shows where the bone's end goes
from one limit to the other while every other angle stays as it is.
"""

from __future__ import annotations

from typing import Final

import numpy as np

from rhot.anatomy.hand import HandModel
from rhot.anatomy.skeleton import FINGERS
from rhot.arrays import FloatArray
from rhot.geometry.rotations import rotation_from_quaternion
from rhot.messages import FingerAngles, HandPose

STEPS: Final = 12
"""Lines of which an arc consists."""
_END_OF_ANGLE: Final = (1, 1, 2, 3)
"""Which point of a finger's chain each angle moves: flexion and abduction the first bone's end, then the hinges'."""
FANS: Final = len(FINGERS) * len(_END_OF_ANGLE)
LINES: Final = FANS * (STEPS + 2)


def limit_lines(model: HandModel, pose: HandPose) -> FloatArray | None:
    """Return the fans of a hand as lines (`LINES`, 2, 3), metres, rig frame; None where the pose tells too little.

    Args:
        model: of the person, of the pose's side.
        pose: with its wrist and the angles of all fingers.
    """
    wrist = pose.joints.get("wrist")
    if wrist is None or any(finger not in pose.angles for finger in FINGERS):
        return None
    angles = np.array([_row(pose.angles[finger]) for finger in FINGERS])
    lines = []
    for column, end in enumerate(_END_OF_ANGLE):
        sweep = np.tile(angles, (STEPS + 1, 1, 1))
        sweep[:, :, column] = np.linspace(model.angle_min[:, column], model.angle_max[:, column], STEPS + 1)
        chain = model.finger_chains(sweep)[0]
        hub, arc = chain[:, :, end - 1], chain[:, :, end]
        for finger in range(len(FINGERS)):
            own = arc[:, finger]
            lines += [(own[k], own[k + 1]) for k in range(STEPS)]
            lines += [(hub[0, finger], own[0]), (hub[-1, finger], own[-1])]
    R = rotation_from_quaternion(np.array(wrist.orientation))
    drawn: FloatArray = np.array(lines) @ R.T + np.array(wrist.position)
    return drawn


def _row(angles: FingerAngles) -> tuple[float, float, float, float]:
    return angles.mcp_flexion, angles.mcp_abduction, angles.pip_flexion, angles.dip_flexion
