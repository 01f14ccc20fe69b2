"""Arrays as the tuples that messages and files carry."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from rhot.messages import Position, Quaternion


def wire_position(vector: NDArray[np.float64]) -> Position:
    """Return a place (3,), metres, as a message's position."""
    x, y, z = vector.tolist()
    return x, y, z


def wire_quaternion(xyzw: NDArray[np.float64]) -> Quaternion:
    """Return a unit quaternion (4,), x y z w, as a message's orientation."""
    x, y, z, w = xyzw.tolist()
    return x, y, z, w
