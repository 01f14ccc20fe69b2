"""What a detected marker has to pass before it is believed.

A misread square moves a foot by metres; a marker that is not believed costs one sixtieth of a second.
"""

from __future__ import annotations

import math
from typing import Final, Literal

import numpy as np
from numpy.typing import NDArray

from rhot.geometry.camera import CameraModel
from rhot.geometry.covariances import squared_distance
from rhot.geometry.rotations import rotation_between
from rhot_feet.depth.floor import FloorPlane
from rhot_feet.depth.plane import DepthPlane
from rhot_feet.marker.detection import MarkerDetection
from rhot_feet.marker.pose import MarkerPose, SquareView, pose_covariance
from rhot_feet.marker.pose_choice import OrientationPrior
from rhot_feet.prediction import GATE_SIGMAS, FootPrediction, innovation_distance

FloatArray = NDArray[np.float64]

Refusal = Literal["border", "shape", "size", "depth", "tilt", "floor", "other", "motion", "turn"]

_BORDER_PX: Final = 3.0
"""Corners closer to the picture's edge are refined on pixels that are not there."""
_MAX_REPROJECTION: Final = 0.04
"""Of the corners, as a share of the side: a square that is bent so far is none."""
_MAX_ASPECT: Final = 5.0
_DEPTH_SHARE: Final = 0.04
"""By so much of the distance may the depth image and the size of the marker contradict each other, besides noise: a
printout at 97 % does as much."""
_DEPTH_SIGMAS: Final = 4.0
_LEAST_HEIGHT_M: Final = 0.025
"""An instep stands higher over the floor; paper that lies on it does not."""
_OTHER_FOOT_M: Final = 0.06
"""Two feet's markers cannot be closer: what sits on the other foot is misread or stuck there."""
_MAX_TURN_RAD: Final = float(np.radians(45.0))
_TURN_SIGMAS: Final = 5.0
"""A marker that is turned otherwise than its foot by both of these is not on it."""
_MAX_TILT_RAD: Final = float(np.radians(100.0))


def refuse_detection(detection: MarkerDetection, camera: CameraModel) -> Refusal | None:
    """Return why corners are not worth a pose, None when they are."""
    corners = detection.corners
    highest = np.array([camera.width, camera.height]) - 1.0 - _BORDER_PX
    if (corners < _BORDER_PX).any() or (corners > highest).any():
        return "border"
    sides = np.linalg.norm(np.roll(corners, -1, axis=0) - corners, axis=1)
    return "shape" if sides.max() > _MAX_ASPECT * sides.min() else None


def refuse_pose(
    pose: MarkerPose,
    view: SquareView,
    detection: MarkerDetection,
    plane: DepthPlane | None,
    depth_range_m: tuple[float, float],
    up_camera: FloatArray | None,
    floor: FloorPlane | None,
    expected: FootPrediction | None,
    other: FootPrediction | None,
    prior: OrientationPrior | None,
) -> Refusal | None:
    """Return why a marker is not believed, None when it is.

    Args:
        pose: the chosen pose.
        view: what the corners alone suggest, for comparison with the depth.
        detection: what it was made from.
        plane: of the depths inside the marker, if there are any.
        depth_range_m: nearest and farthest believable marker.
        up_camera: (3,) unit vector against gravity, camera frame, where it is known.
        floor: the floor, where it is known.
        expected: the filter's prediction, where there is one.
        other: the same of the other foot.
        prior: how the marker is expected to be turned, where that is known.
    """
    position = pose.t_camera_marker
    wrong: dict[Refusal, bool] = {
        "size": not depth_range_m[0] <= float(position[2]) <= depth_range_m[1],
        "shape": view.reprojection_px > max(1.0, _MAX_REPROJECTION * detection.side_px),
        "depth": plane is not None and not _depth_agrees(view, plane),
        "tilt": up_camera is not None and float(pose.normal @ up_camera) < np.cos(_MAX_TILT_RAD),
        "floor": floor is not None and float(floor.heights_m(position)) < _LEAST_HEIGHT_M,
        "other": other is not None and _is_nearer(position, other, expected),
        "motion": expected is not None
        and innovation_distance(position, pose.covariance[3:, 3:], expected) > GATE_SIGMAS,
        "turn": prior is not None and _is_turned(pose, prior),
    }
    return next((reason for reason, holds in wrong.items() if holds), None)


def _is_turned(pose: MarkerPose, prior: OrientationPrior) -> bool:
    turn = rotation_between(prior.R_camera_marker, pose.R_camera_marker)
    sigmas = math.sqrt(squared_distance(turn, pose.covariance[:3, :3] + prior.covariance))
    return float(np.linalg.norm(turn)) > _MAX_TURN_RAD and sigmas > _TURN_SIGMAS


def _is_nearer(position: FloatArray, other: FootPrediction, own: FootPrediction | None) -> bool:
    """Tell whether a position is that of the other foot, and rather its than one's own."""
    to_other = float(np.linalg.norm(position - other.position))
    return to_other < _OTHER_FOOT_M and (own is None or to_other < float(np.linalg.norm(position - own.position)))


def _depth_agrees(view: SquareView, plane: DepthPlane) -> bool:
    x, y, z = view.t[0]
    xy = np.array([x / z, y / z])
    sigma = float(np.hypot(np.sqrt(pose_covariance(view)[0, 5, 5]), plane.depth_sigma_m(xy)))
    return abs(plane.depth_m(xy) - float(z)) <= _DEPTH_SIGMAS * sigma + _DEPTH_SHARE * float(z)
