"""Gates that a detected marker has to pass before it is used.

A misread square moves a foot by metres; rejecting a marker only loses one frame.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Final, Literal

import numpy as np

from rhot.arrays import FloatArray
from rhot.geometry.camera import CameraModel
from rhot.geometry.covariances import squared_distance
from rhot.geometry.rotations import rotation_between
from rhot_feet.depth.floor import FloorPlane
from rhot_feet.depth.plane import DepthPlane
from rhot_feet.marker.detection import MarkerDetection
from rhot_feet.marker.pose import MarkerPose, SquareView, pose_covariance
from rhot_feet.marker.pose_choice import OrientationPrior
from rhot_feet.prediction import GATE_SIGMAS, FootPrediction, innovation_distance

Refusal = Literal["border", "shape", "size", "depth", "tilt", "floor", "other", "motion", "turn"]


@dataclass(frozen=True, slots=True)
class MarkerGateSettings:
    """Limits of the gates; chosen on `rhot evaluate feet`, tasks with false markers.

    Attributes:
        border_px: smallest distance of a corner from the image border; closer ones cannot be refined.
        most_reprojection: largest reprojection error of the corners, as a share of the side.
        most_aspect: largest ratio of the longest to the shortest side.
        depth_share, depth_sigmas: largest difference between the depth image and the distance from the marker's size,
            as a share of the distance plus a number of standard deviations; a printout at 97 % differs by as much.
        least_height_m: smallest height above the floor; excludes printed markers that lie on the floor.
        other_foot_m: smallest distance from the other foot's marker; a closer one is misread, or is on the other foot.
        most_rotation_rad, rotation_sigmas: a marker is rejected if its orientation differs from the foot's by more than
            both of these.
        most_tilt_rad: largest angle between its normal and up.
    """

    border_px: float = 3.0
    most_reprojection: float = 0.04
    most_aspect: float = 5.0
    depth_share: float = 0.04
    depth_sigmas: float = 4.0
    least_height_m: float = 0.025
    other_foot_m: float = 0.06
    most_rotation_rad: float = float(np.radians(45.0))
    rotation_sigmas: float = 5.0
    most_tilt_rad: float = float(np.radians(100.0))


SETTINGS: Final = MarkerGateSettings()


def refuse_detection(detection: MarkerDetection, camera: CameraModel) -> Refusal | None:
    """Return why a detection is rejected by its corners alone; None if it is not."""
    corners = detection.corners
    highest = np.array([camera.width, camera.height]) - 1.0 - SETTINGS.border_px
    if (corners < SETTINGS.border_px).any() or (corners > highest).any():
        return "border"
    sides = np.linalg.norm(np.roll(corners, -1, axis=0) - corners, axis=1)
    return "shape" if sides.max() > SETTINGS.most_aspect * sides.min() else None


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
    """Return why a marker is rejected; None if it is accepted.

    Args:
        pose: the chosen pose.
        view: the poses from the corners alone, for comparison with the depth.
        detection: the detected marker.
        plane: fitted to the depths inside the marker, if there are any.
        depth_range_m: smallest and largest plausible distance.
        up_camera: (3,) unit vector against gravity, camera frame, if known.
        floor: the floor, if known.
        expected: the filter's prediction, if there is one.
        other: prediction of the other foot, if there is one.
        prior: the predicted orientation, if known.
    """
    position = pose.t_camera_marker
    wrong: dict[Refusal, bool] = {
        "size": not depth_range_m[0] <= float(position[2]) <= depth_range_m[1],
        "shape": view.reprojection_px > max(1.0, SETTINGS.most_reprojection * detection.side_px),
        "depth": plane is not None and not _depth_agrees(view, plane),
        "tilt": up_camera is not None and float(pose.normal @ up_camera) < np.cos(SETTINGS.most_tilt_rad),
        "floor": floor is not None and float(floor.heights_m(position)) < SETTINGS.least_height_m,
        "other": other is not None and _is_nearer(position, other, expected),
        "motion": expected is not None
        and innovation_distance(position, pose.covariance[3:, 3:], expected) > GATE_SIGMAS,
        "turn": prior is not None and _is_rotated(pose, prior),
    }
    return next((reason for reason, holds in wrong.items() if holds), None)


def _is_rotated(pose: MarkerPose, prior: OrientationPrior) -> bool:
    turn = rotation_between(prior.R_camera_marker, pose.R_camera_marker)
    sigmas = math.sqrt(squared_distance(turn, pose.covariance[:3, :3] + prior.covariance))
    return float(np.linalg.norm(turn)) > SETTINGS.most_rotation_rad and sigmas > SETTINGS.rotation_sigmas


def _is_nearer(position: FloatArray, other: FootPrediction, own: FootPrediction | None) -> bool:
    """Return whether a position (3,) coincides with the other foot, and is closer to it than to the own foot."""
    to_other = float(np.linalg.norm(position - other.position))
    return to_other < SETTINGS.other_foot_m and (
        own is None or to_other < float(np.linalg.norm(position - own.position))
    )


def _depth_agrees(view: SquareView, plane: DepthPlane) -> bool:
    x, y, z = view.t[0]
    xy = np.array([x / z, y / z])
    sigma = float(np.hypot(np.sqrt(pose_covariance(view)[0, 5, 5]), plane.depth_sigma_m(xy)))
    return abs(plane.depth_m(xy) - float(z)) <= SETTINGS.depth_sigmas * sigma + SETTINGS.depth_share * float(z)
