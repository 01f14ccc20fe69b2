"""The turn between two orientations of a foot."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from rhot.rotations import vector_from_rotation

FloatArray = NDArray[np.float64]


def rotation_between(R0: FloatArray, R1: FloatArray) -> FloatArray:
    """Return the rotation vector (3,), radians, in the outer frame, that takes R0 (3, 3) to R1: R1 = exp([v]×)·R0."""
    turn = R1 @ R0.T
    (a, b, c), (d, e, f), (g, h, i) = turn.tolist()
    cosine = 0.5 * (a + e + i - 1.0)
    if cosine < 0.0:
        return vector_from_rotation(turn)
    x, y, z = 0.5 * (h - f), 0.5 * (c - g), 0.5 * (d - b)
    sine = math.sqrt(x * x + y * y + z * z)
    scale = 1.0 if sine < 1e-9 else math.atan2(sine, cosine) / sine
    return np.array([x * scale, y * scale, z * scale])
