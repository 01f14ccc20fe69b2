"""A pose of the simulated world as the message that carries it."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from rhot.geometry.rotations import quaternion_from_rotation
from rhot.messages import TruePose
from rhot.messages.vectors import wire_position, wire_quaternion


def true_pose(T: NDArray[np.float64]) -> TruePose:
    """Return the message's form of a transform (4, 4), metres."""
    return TruePose(position=wire_position(T[:3, 3]), orientation=wire_quaternion(quaternion_from_rotation(T[:3, :3])))
