"""A pose of the simulated world as the message that carries it."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from rhot.messages import TruePose
from rhot.rotations import quaternion_from_rotation


def true_pose(T: NDArray[np.float64]) -> TruePose:
    """Return the message's form of a transform (4, 4), metres."""
    x, y, z = (float(value) for value in T[:3, 3])
    qx, qy, qz, qw = (float(value) for value in quaternion_from_rotation(T[:3, :3]))
    return TruePose(position=(x, y, z), orientation=(qx, qy, qz, qw))
