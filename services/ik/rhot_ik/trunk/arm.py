"""An arm in closed form: two bones between a shoulder and a tracked wrist.

Two bones of known length leave one angle open: where on a circle the elbow is. Nobody measures it. Held straight
ahead, an elbow hangs down and a little outwards; for any other direction of the wrist that is carried along by the
smallest rotation. So an elbow is behind a hanging arm, under one stretched to the side, and before one raised over the
head, and it goes everywhere without a jump but straight through the trunk to the back, where no wrist goes.
"""

from __future__ import annotations

from typing import Final

import numpy as np

from rhot.arrays import FloatArray
from rhot.geometry.rotations import shortest_rotation
from rhot.geometry.transforms import rigid
from rhot.messages import Side
from rhot_ik.legs.hips import OUTWARDS
from rhot_ik.legs.leg import bend_leg

_AHEAD: Final = np.array([0.0, 0.0, -1.0])
_ELBOW: Final = np.array([0.34, -0.94, 0.0])
"""Where the elbow of an arm held straight ahead is from the line to its wrist: 20° outwards of down. A choice that
looks natural, no measurement; chest axes of the right side."""
_TO_ARM: Final = np.diag([-1.0, 1.0, -1.0])
"""From the frame of a knee's bones, whose hinge points the other way, to that of an arm's."""
LONGEST: Final = 1.25
"""Of the arm's length: a wrist that is farther from the shoulder is not this person's. Room for a shoulder that is
drawn forwards (40 mm) and for a person with other proportions."""


def solve_arm(
    side: Side, R_chest: FloatArray, shoulder: FloatArray, T_rig_wrist: FloatArray, upper_m: float, forearm_m: float
) -> dict[str, FloatArray] | None:
    """Return `<side>_shoulder`, `_elbow` and `_wrist`, (4, 4) each in the rig frame; None when it is out of reach.

    Args:
        side: whose arm.
        R_chest: (3, 3) axes of the chest.
        shoulder: (3,) metres.
        T_rig_wrist: (4, 4) wrist of the hand, OpenXR's hand axes.
        upper_m, forearm_m: lengths.
    """
    wrist = T_rig_wrist[:3, 3]
    line = wrist - shoulder
    far = float(np.linalg.norm(line))
    if far > LONGEST * (upper_m + forearm_m):
        return None
    direction = line / far if far > 1e-6 else R_chest @ _AHEAD
    carried = shortest_rotation(_AHEAD, R_chest.T @ direction)
    elbow = R_chest @ carried @ (_ELBOW * np.array([OUTWARDS[side], 1.0, 1.0]))
    arm = bend_leg(shoulder, wrist, np.cross(direction, elbow), upper_m, forearm_m)
    return {
        f"{side}_shoulder": rigid(arm.R_thigh @ _TO_ARM, arm.hip),
        f"{side}_elbow": rigid(arm.R_shank @ _TO_ARM, arm.knee),
        f"{side}_wrist": rigid(hand_axes(side, T_rig_wrist[:3, :3]), arm.ankle),
    }


def hand_axes(side: Side, R_rig_wrist: FloatArray) -> FloatArray:
    """Return the axes of a wrist as in `BodyJoint` (3, 3) from those of `HandPose`."""
    out = OUTWARDS[side]
    # Of a hanging hand OpenXR's +Y, out of its back, points outwards and its +Z, to the wrist, upwards.
    return np.stack([out * R_rig_wrist[:, 1], R_rig_wrist[:, 2], out * R_rig_wrist[:, 0]], axis=-1)
