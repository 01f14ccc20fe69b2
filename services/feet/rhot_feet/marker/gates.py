"""What a detected marker has to pass before it is believed.

A misread square moves a foot by metres; a marker that is not believed costs one sixtieth of a second.
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
    """What a marker has to pass; chosen on `rhot evaluate feet`, tasks with false markers.

    Attributes:
        border_px: corners closer to the picture's edge are refined on pixels that are not there. most_reprojection: of
        the corners, as a share of the side: a square bent so far is none. most_aspect: longest side over shortest.
        depth_share, depth_sigmas: how far the depth image and the marker's size may disagree, as a share of the
        distance
            and beside the noise: a printout at 97 % does as much.
        least_height_m: an instep stands higher over the floor; paper that lies on it does not.
        other_foot_m: two feet's markers cannot be closer: what sits on the other foot is misread or stuck there.
        most_rotation_rad, rotation_sigmas: a marker rotated against its foot by both of these is not on it.
        most_tilt_rad: of its normal from up.
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
    """Return why corners are not worth a pose, None when they are."""
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
        prior: the predicted orientation, where it is known.
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
    """Return whether a position is that of the other foot, and rather its than one's own."""
    to_other = float(np.linalg.norm(position - other.position))
    return to_other < SETTINGS.other_foot_m and (
        own is None or to_other < float(np.linalg.norm(position - own.position))
    )


def _depth_agrees(view: SquareView, plane: DepthPlane) -> bool:
    x, y, z = view.t[0]
    xy = np.array([x / z, y / z])
    sigma = float(np.hypot(np.sqrt(pose_covariance(view)[0, 5, 5]), plane.depth_sigma_m(xy)))
    return abs(plane.depth_m(xy) - float(z)) <= SETTINGS.depth_sigmas * sigma + SETTINGS.depth_share * float(z)
