"""Angles of fingers within the limits of their joints."""

from __future__ import annotations

import numpy as np

from rhot.anatomy.hand import HandModel
from rhot.arrays import FloatArray


def legal_angles(model: HandModel, seed: int, count: int) -> FloatArray:
    """Return angles (count, 5, 4), radians, evenly drawn; the last hinge follows the middle one."""
    rng = np.random.default_rng(seed)
    angles = rng.uniform(model.angle_min, model.angle_max, (count, 5, 4))
    angles[..., 3] = np.minimum(angles[..., 2] * model.coupling, model.angle_max[:, 3])
    return angles
