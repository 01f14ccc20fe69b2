"""Names of the arrays that the geometry works on; shape, unit and frame stand where one is used."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]
BoolArray = NDArray[np.bool_]
IndexArray = NDArray[np.intp]
"""Rows or columns of other arrays."""
