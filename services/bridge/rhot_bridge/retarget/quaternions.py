"""Products of many quaternions, x y z w, in a few numpy calls."""

from __future__ import annotations

from typing import Final

import numpy as np

from rhot.arrays import FloatArray

_IDENTITY: Final = np.array([0.0, 0.0, 0.0, 1.0])


def conjugate(xyzw: FloatArray) -> FloatArray:
    """Return the inverse of unit quaternions (..., 4)."""
    inverse: FloatArray = xyzw * np.array([-1.0, -1.0, -1.0, 1.0])
    return inverse


def right_product(xyzw: FloatArray) -> FloatArray:
    """Return the matrices (N, 4, 4) of quaternions r (N, 4) for which q @ matrix = q ⊗ r."""
    x, y, z, w = xyzw.T
    rows = [[w, -z, y, -x], [z, w, -x, -y], [-y, x, w, -z], [x, y, z, w]]
    return np.moveaxis(np.array(rows), -1, 0)


def relative(parents: FloatArray, children: FloatArray) -> FloatArray:
    """Return the quaternions parent⁻¹ ⊗ child (N, 4) of parents (N, 4), or one parent (4,), and children (N, 4)."""
    a, b, c, d = parents.T
    x, y, z, w = children.T
    found = np.empty_like(children)
    found[:, 0] = d * x - a * w - b * z + c * y
    found[:, 1] = d * y + a * z - b * w - c * x
    found[:, 2] = d * z - a * y + b * x - c * w
    found[:, 3] = d * w + a * x + b * y + c * z
    return found


def faded(quaternions: FloatArray, weight: float) -> FloatArray:
    """Return rotations (..., 4) interpolated towards the identity as the weight falls from 1 to 0."""
    if weight >= 1.0:
        return quaternions
    near = np.where(quaternions[..., 3:] < 0.0, -quaternions, quaternions)
    mixed = weight * near + (1.0 - weight) * _IDENTITY
    unit: FloatArray = mixed / np.linalg.norm(mixed, axis=-1, keepdims=True)
    return unit
