"""Choosing between the two poses of a square: by fit to the picture, by expectation and by plausibility."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np

from rhot.arrays import FloatArray
from rhot.geometry.covariances import squared_distance
from rhot.geometry.rotations import rotation_between
from rhot_feet.marker.pose import MarkerPose

CLEAR_MARGIN: Final = 6.0
"""Difference of −2·log-likelihood from which the better pose is believed: odds of 20 to 1."""
_UPRIGHT_RAD: Final = float(np.radians(75.0))
_UPRIGHT_SIGMA_RAD: Final = float(np.radians(10.0))
"""Feet tilt up to about 75° when the heel leaves the floor; beyond that a marker's normal is ever less plausible."""


@dataclass(frozen=True, slots=True)
class OrientationPrior:
    """The predicted orientation of a marker.

    Attributes:
        R_camera_marker: (3, 3).
        covariance: (3, 3) of a rotation about the camera's axes, square radians.
    """

    R_camera_marker: FloatArray
    covariance: FloatArray


@dataclass(frozen=True, slots=True)
class PoseChoice:
    """The chosen pose.

    Attributes:
        pose: the likeliest.
        margin: difference of −2·log-likelihood to the other one; infinite when there is none.
    """

    pose: MarkerPose
    margin: float

    @property
    def clear(self) -> bool:
        """Whether the orientation may be believed; the position may in any case, both solutions nearly share it."""
        return self.margin >= CLEAR_MARGIN


def choose_pose(
    poses: Sequence[MarkerPose],
    *,
    prior: OrientationPrior | None = None,
    up_camera: FloatArray | None = None,
) -> PoseChoice | None:
    """Return the likeliest of the poses of one marker; None when there are none.

    Args:
        poses: see `marker_poses`; their costs hold the reprojection errors and the depth's normal.
        prior: expected orientation, from a filter or an inertial sensor.
        up_camera: (3,) unit vector against gravity, camera frame; a foot's marker looks up.
    """
    if not poses:
        return None
    ranked = sorted(
        ((pose.cost + _nis(pose, prior) + _implausibility(pose, up_camera), pose) for pose in poses),
        key=lambda scored: scored[0],
    )
    margin = ranked[1][0] - ranked[0][0] if len(ranked) > 1 else float("inf")
    return PoseChoice(ranked[0][1], margin)


def _nis(pose: MarkerPose, prior: OrientationPrior | None) -> float:
    if prior is None:
        return 0.0
    turn = rotation_between(prior.R_camera_marker, pose.R_camera_marker)
    distance = squared_distance(turn, pose.covariance[:3, :3] + prior.covariance)
    # An expectation that is wrong altogether must not outweigh everything that is seen.
    return min(distance, 40.0)


def _implausibility(pose: MarkerPose, up_camera: FloatArray | None) -> float:
    if up_camera is None:
        return 0.0
    tilt = float(np.arccos(np.clip(pose.normal @ up_camera, -1.0, 1.0)))
    return max(0.0, (tilt - _UPRIGHT_RAD) / _UPRIGHT_SIGMA_RAD) ** 2
