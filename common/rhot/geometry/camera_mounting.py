"""How the depth camera sits on the head."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from rhot.geometry.rotations import rotation_x
from rhot.geometry.transforms import rigid

if TYPE_CHECKING:
    from rhot.rig.feet_config import DepthCameraConfig


def camera_mounting(config: DepthCameraConfig) -> NDArray[np.float64]:
    """Return T_head_camera (4, 4): OpenCV's camera axes in the head's (x right, y up, -z forward), pitched down."""
    R = rotation_x(-math.radians(config.pitch_deg)) @ np.diag([1.0, -1.0, -1.0])
    return rigid(R, np.array(config.position_m))
