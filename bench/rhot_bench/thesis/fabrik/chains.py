"""Chains of limited joints, many of the same build at once.

A chain hangs at the origin of its own base frame, so limits turn with whatever carries it. Joint k turns the bone
behind it by

    R_k = R_{k−1} · rest_k · Ry(abduction_k) · Rx(−flexion_k) · Rz(twist_k),    p_{k+1} = p_k + R_k · bone_k

and its build lies in its ranges alone: a hinge leaves only flexion free (its axis is x of its rest frame, which may
point anywhere), a saddle or knuckle flexion and abduction, a ball all three. Limits of the swing are a rectangle
in (flexion, abduction): an elliptic cone inside it, tried on recorded hands, forbids a tenth of their true knuckles and
puts the joints after them 0.2 to 1.3 mm further off (docs/hand.md).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np

from rhot.arrays import FloatArray

FLEXION: Final = 0
ABDUCTION: Final = 1
TWIST: Final = 2


@dataclass(frozen=True, slots=True)
class Chains:
    """B chains of n joints each.

    Attributes:
        rest: (B, n, 3, 3) rest frame of each joint in the frame of the bone before it.
        bones: (B, n, 3) metres: each bone in the frame of its joint, usually along −z.
        lowest, highest: (B, n, 3) radians: ranges of flexion, abduction and twist; each holds 0.
        coupling: (B, n) a hinge follows the hinge before it by this factor; NaN where it is free.
    """

    rest: FloatArray
    bones: FloatArray
    lowest: FloatArray
    highest: FloatArray
    coupling: FloatArray

    @property
    def count(self) -> int:
        """Number of joints n of each chain."""
        return int(self.bones.shape[1])

    @property
    def lengths(self) -> FloatArray:
        """(B, n) metres."""
        found: FloatArray = np.sqrt((self.bones**2).sum(-1))
        return found

    def clamp(self, angles: FloatArray) -> FloatArray:
        """Return angles (B, n, 3) brought inside the limits; what is not a number becomes the nearest to 0."""
        finite = np.nan_to_num(angles, nan=0.0)
        return np.clip(finite, self.lowest, self.highest)

    def forward(self, angles: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return points (B, n + 1, 3), metres, and axes (B, n, 3, 3) of the bones, both in the base frame."""
        points = np.zeros((len(angles), self.count + 1, 3))
        axes = np.empty((len(angles), self.count, 3, 3))
        turns = joint_rotations(angles)
        for joint in range(self.count):
            frame = self.rest[:, joint] if joint == 0 else axes[:, joint - 1] @ self.rest[:, joint]
            axes[:, joint] = frame @ turns[:, joint]
            points[:, joint + 1] = points[:, joint] + (axes[:, joint] @ self.bones[:, joint, :, None])[..., 0]
        return points, axes


def joint_rotations(angles: FloatArray) -> FloatArray:
    """Return Ry(abduction) · Rx(−flexion) · Rz(twist), (..., 3, 3), of angles (..., 3)."""
    cos, sin = np.cos(angles), np.sin(angles)
    cf, ca, ct = cos[..., 0], cos[..., 1], cos[..., 2]
    sf, sa, st = sin[..., 0], sin[..., 1], sin[..., 2]
    R = np.empty((*angles.shape[:-1], 3, 3))
    R[..., 0, 0] = ca * ct - sa * sf * st
    R[..., 0, 1] = -ca * st - sa * sf * ct
    R[..., 0, 2] = sa * cf
    R[..., 1, 0] = cf * st
    R[..., 1, 1] = cf * ct
    R[..., 1, 2] = sf
    R[..., 2, 0] = -sa * ct - ca * sf * st
    R[..., 2, 1] = sa * st - ca * sf * ct
    R[..., 2, 2] = ca * cf
    return R
