"""Vector algebra on plain floats, for arrays too small for numpy to be faster."""

from __future__ import annotations

import math
from bisect import bisect_right
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

Vector = tuple[float, float, float]


def vector(values: NDArray[np.float64]) -> Vector:
    """Return an array (3,) as a tuple."""
    x, y, z = values.tolist()
    return x, y, z


def dot(a: Vector, b: Vector) -> float:
    """Return a·b."""
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


def across(a: Vector, unit: Vector) -> Vector:
    """Return the component of a vector perpendicular to a unit vector."""
    along = dot(a, unit)
    return a[0] - along * unit[0], a[1] - along * unit[1], a[2] - along * unit[2]


def unit(a: Vector) -> Vector:
    """Return the unit vector in the direction of a; shorter if a is shorter than 1e-6."""
    scale = 1.0 / max(math.sqrt(dot(a, a)), 1e-6)
    return scale * a[0], scale * a[1], scale * a[2]


def interpolated(x: float, known: Sequence[float], values: Sequence[float]) -> float:
    """Return the linear interpolation at x of values at ascending `known`, constant beyond both ends: np.interp."""
    after = bisect_right(known, x)
    if after in (0, len(known)):
        return values[max(after - 1, 0)]
    share = (x - known[after - 1]) / (known[after] - known[after - 1])
    return values[after - 1] + share * (values[after] - values[after - 1])
