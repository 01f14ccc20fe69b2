"""An image of the feet with its camera's pose, the predictions and the detections."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Final

import numpy as np

from rhot.arrays import FloatArray
from rhot.messages import Side
from rhot_feet.depth.tracker import DepthObservations
from rhot_feet.frames import DepthFrame
from rhot_feet.marker.tracker import MarkerObservations
from rhot_feet.prediction import FootPrediction

HEAD_ROTATION_RAD: Final = float(np.radians(0.1))
"""Noise of the head's orientation, per axis; it swings the camera's line of sight."""
HEAD_POSITION_M: Final = 0.0005
"""Noise of the head's position, per axis."""


@dataclass(frozen=True, slots=True)
class View:
    """A picture, where its camera was, and what it is expected to show.

    Attributes:
        frame: the picture.
        T_rig_camera: (4, 4) at the middle of its exposure.
        expected: foot to where the filter predicts it.
    """

    frame: DepthFrame
    T_rig_camera: FloatArray
    expected: Mapping[Side, FootPrediction]

    def in_rig(self, position: FloatArray) -> FloatArray:
        """Return a position (3,) of the camera frame in the rig frame."""
        rig: FloatArray = self.T_rig_camera[:3, :3] @ position + self.T_rig_camera[:3, 3]
        return rig

    def covariance_in_rig(self, position: FloatArray, covariance: FloatArray) -> FloatArray:
        """Return the covariance (3, 3) in the rig frame of a position seen from a head whose own pose is noisy."""
        R = self.T_rig_camera[:3, :3]
        rotation = HEAD_ROTATION_RAD**2 * (float(position @ position) * np.eye(3) - np.outer(position, position))
        rig: FloatArray = R @ (covariance + rotation) @ R.T + HEAD_POSITION_M**2 * np.eye(3)
        return rig


@dataclass(frozen=True, slots=True)
class FootDetections:
    """What a picture showed.

    Attributes:
        view: the picture.
        markers: by the marker stage.
        blobs: by the depth stage.
    """

    view: View
    markers: MarkerObservations
    blobs: DepthObservations
