"""The whole upper body from hips, head and tracked hands."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from rhot.anatomy.body_proportions import BodyModel
from rhot.arrays import FloatArray
from rhot.messages import Side
from rhot_ik.legs.hips import OUTWARDS
from rhot_ik.trunk.arm import solve_arm
from rhot_ik.trunk.spine import spine


def solve_upper_body(
    T_rig_hips: FloatArray, T_rig_head: FloatArray, wrists: Mapping[Side, FloatArray], body: BodyModel
) -> dict[str, FloatArray]:
    """Return the joints above the hips by name, as in `BodyPose`, (4, 4) each in the rig frame.

    Args:
        T_rig_hips: (4, 4) middle between the hip joints.
        T_rig_head: (4, 4) headset, OpenXR axes.
        wrists: (4, 4) of the tracked hands, OpenXR's hand axes; an arm that cannot reach its wrist is left out.
        body: lengths.
    """
    joints = spine(T_rig_hips, T_rig_head, body)
    R_chest, neck = joints["chest"][:3, :3], joints["neck"][:3, 3]
    for side, T_rig_wrist in wrists.items():
        shoulder = neck + R_chest @ (np.array(body.shoulder_m) * [OUTWARDS[side], 1.0, 1.0])
        arm = solve_arm(side, R_chest, shoulder, T_rig_wrist, body.upper_arm_m, body.forearm_m)
        if arm is not None:
            joints |= arm
    return joints
