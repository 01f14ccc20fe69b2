"""Vectors as plain numbers, where there are too few for numpy."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Vector = tuple[float, float, float]


def vector(values: NDArray[np.float64]) -> Vector:
    """Return an array (3,) as numbers."""
    x, y, z = values.tolist()
    return x, y, z
