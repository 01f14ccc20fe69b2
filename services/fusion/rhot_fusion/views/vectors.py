"""Vector algebra on plain floats, for arrays that are too small for numpy to pay off."""

from __future__ import annotations

import math
from bisect import bisect_right
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

Vector = tuple[float, float, float]


def vector(values: NDArray[np.float64]) -> Vector:
    """Return an array (3,) as numbers."""
    x, y, z = values.tolist()
    return x, y, z


def dot(a: Vector, b: Vector) -> float:
    """Return a·b."""
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


def across(a: Vector, unit: Vector) -> Vector:
    """Return what of a vector is across a direction of length 1."""
    along = dot(a, unit)
    return a[0] - along * unit[0], a[1] - along * unit[1], a[2] - along * unit[2]


def unit(a: Vector) -> Vector:
    """Return a vector of length 1 in the direction of another; of almost nothing, something shorter."""
    scale = 1.0 / max(math.sqrt(dot(a, a)), 1e-6)
    return scale * a[0], scale * a[1], scale * a[2]


def interpolated(x: float, known: Sequence[float], values: Sequence[float]) -> float:
    """Return the value at x between those known at ascending places, beyond them that of the nearest: np.interp."""
    after = bisect_right(known, x)
    if after in (0, len(known)):
        return values[max(after - 1, 0)]
    share = (x - known[after - 1]) / (known[after] - known[after - 1])
    return values[after - 1] + share * (values[after] - values[after - 1])
