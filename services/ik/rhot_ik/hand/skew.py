"""The cross product as a matrix: [v]×·w = v × w."""

from __future__ import annotations

from typing import Final

import numpy as np
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]

CROSS: Final = np.array(
    [
        [0.0, 0.0, 0.0, 0.0, 0.0, -1.0, 0.0, 1.0, 0.0],
        [0.0, 0.0, 1.0, 0.0, 0.0, 0.0, -1.0, 0.0, 0.0],
        [0.0, -1.0, 0.0, 1.0, 0.0, 0.0, 0.0, 0.0, 0.0],
    ]
)
"""(3, 9): v @ CROSS is [v]×, row by row."""


def skew(v: FloatArray) -> FloatArray:
    """Return [v]× (..., 3, 3) of vectors (..., 3)."""
    crossed: FloatArray = (v @ CROSS).reshape(*v.shape, 3)
    return crossed
