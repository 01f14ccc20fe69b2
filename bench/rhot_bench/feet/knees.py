"""The knees in the simulated runs of the foot tracker, against the truth."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from rhot.arrays import FloatArray
from rhot.geometry.rotations import rotation_from_quaternion
from rhot.messages import BodyPose
from rhot_bench.feet.heads import START_NS
from rhot_sim.walker.world import WalkerWorld


def knee_errors(bodies: Sequence[BodyPose], world: WalkerWorld) -> tuple[FloatArray, int]:
    """Return the knees' distances from the truth, metres, and how many frames have a knee bent backwards."""
    if not bodies:
        return np.empty(0), 0
    t_s = np.array([1e-9 * (body.t_ns - START_NS) for body in bodies])
    truth = world.joints(t_s)
    errors: list[float] = []
    backwards = 0
    for k, body in enumerate(bodies):
        wrong = False
        for side in body.legs:
            knee, hip = body.joints[f"{side}_knee"], body.joints[f"{side}_hip"]
            errors.append(float(np.linalg.norm(np.array(knee.position) - truth[f"{side}_knee"][k, :3, 3])))
            R_thigh, R_shank = (rotation_from_quaternion(np.array(joint.orientation)) for joint in (hip, knee))
            # Both have their hinge along x; a bent knee turns the shank backwards, which is about -x.
            wrong |= not bool((R_thigh.T @ R_shank)[2, 1] < 1e-6)
        backwards += wrong
    return np.array(errors), backwards
