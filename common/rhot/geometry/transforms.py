"""Small pure functions on rigid transforms: T_a_b is (4, 4) and maps coordinates of frame b to frame a, metres."""

from __future__ import annotations

import numpy as np

from rhot.arrays import FloatArray


def rigid(R: FloatArray, t: FloatArray) -> FloatArray:
    """Return the transform (4, 4) of a rotation (3, 3) and a translation (3,)."""
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = R, t
    return T


def inverse(T: FloatArray) -> FloatArray:
    """Return the inverse of a rigid transform (4, 4)."""
    return rigid(T[:3, :3].T, -T[:3, :3].T @ T[:3, 3])
