"""Where the next picture is expected to show a foot."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Final

import numpy as np

from rhot.arrays import FloatArray
from rhot.geometry.camera import CameraModel
from rhot.geometry.covariances import squared_distance
from rhot.geometry.hull import Region
from rhot.types import Side

OTHER_FOOT: Final[dict[Side, Side]] = {"left": "right", "right": "left"}
GATE_SIGMAS = 4.0
"""A position that lies farther from the expected one than this is somebody else's."""
_MARGIN_PX = 10.0


@dataclass(frozen=True, slots=True)
class FootPrediction:
    """A foot at the time of a picture, as the filter predicts it.

    Attributes:
        position: (3,) centre of its marker, metres, camera frame.
        covariance: (3, 3) of the position, square metres; it has to grow honestly while the foot is not seen,
            because what lies outside is refused.
        R_camera_foot: (3, 3), see `rhot.messages.FootPose`; None when nothing is known of it.
        orientation_covariance: (3, 3) of a rotation about the camera's axes, square radians; used with `R_camera_foot`.
    """

    position: FloatArray
    covariance: FloatArray
    R_camera_foot: FloatArray | None = None
    orientation_covariance: FloatArray | None = None


def predicted_region(expected: FootPrediction, radius_m: float, camera: CameraModel) -> Region | None:
    """Return the part of the picture where something within `radius_m` of the foot may be; None = outside of it."""
    z = float(expected.position[2])
    if z < 0.1:
        return None
    u, v = camera.project(expected.position[None])[0]
    spread = GATE_SIGMAS * float(np.sqrt(np.linalg.eigvalsh(expected.covariance)[-1]))
    reach = (spread + radius_m) * float(camera.K[0, 0]) / z + _MARGIN_PX
    left, top = max(0, int(u - reach)), max(0, int(v - reach))
    right, bottom = min(camera.width, int(u + reach) + 1), min(camera.height, int(v + reach) + 1)
    return Region(left, top, right, bottom) if right > left and bottom > top else None


def innovation_distance(position: FloatArray, covariance: FloatArray, expected: FootPrediction) -> float:
    """Return the Mahalanobis distance, in standard deviations, of a measured position from the expected one.

    Args:
        position: (3,) metres, camera frame.
        covariance: (3, 3) of the measured position.
        expected: what was predicted.
    """
    return math.sqrt(squared_distance(position - expected.position, covariance + expected.covariance))
