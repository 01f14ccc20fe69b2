"""Types of the arrays that are passed around; shape, unit and frame stand where one is used."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]
BoolArray = NDArray[np.bool_]
IntArray = NDArray[np.int64]
"""Counts and times, such as nanoseconds."""
IndexArray = NDArray[np.intp]
"""Rows or columns of other arrays."""
ImageArray = NDArray[np.uint8]
"""An image, or a mask of one."""
