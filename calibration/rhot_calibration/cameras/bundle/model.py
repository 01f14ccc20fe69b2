"""What bundle adjustment works with: observations, the geometry that is estimated, and what is known beforehand."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from rhot.arrays import BoolArray, FloatArray, IntArray
from rhot_calibration.cameras.bundle.lens import project


@dataclass(frozen=True, slots=True)
class Observations:
    """V views of the board, padded to its N corners.

    Attributes:
        camera: (V,) index of the camera.
        place: (V,) index of the place at which the board stood.
        uv: (V, N, 2) pixels; 0 where a corner was not seen.
        seen: (V, N) which corners were.
    """

    camera: IntArray
    place: IntArray
    uv: FloatArray
    seen: BoolArray


@dataclass(frozen=True, slots=True)
class Geometry:
    """What is estimated.

    Attributes:
        lenses: (C, 9) in the order of `lens.LENS_NAMES`.
        camera_R: (C, 3, 3) and
        camera_t: (C, 3) metres: T_camera_rig of each camera; the first is the rig frame and stays.
        board_R: (P, 3, 3) and
        board_t: (P, 3) metres: T_rig_board of each place.
        corners: (N, 3) metres, board frame.
    """

    lenses: FloatArray
    camera_R: FloatArray  # noqa: N815
    camera_t: FloatArray
    board_R: FloatArray  # noqa: N815
    board_t: FloatArray
    corners: FloatArray


@dataclass(frozen=True, slots=True)
class Prior:
    """What is known beforehand.

    Attributes:
        lenses: (C, 9) expected parameters.
        lens_sd: (9,) their standard deviations; 0 holds a parameter.
        aspect_sd: standard deviation of fy/fx − 1.
        corners: (N, 3) expected corners, metres.
        corner_sd: (3,) standard deviations along x, y and z, metres; None = the corners are held.
        cameras_held: whether the poses of the cameras are known.
    """

    lenses: FloatArray
    lens_sd: FloatArray
    aspect_sd: float
    corners: FloatArray
    corner_sd: FloatArray | None
    cameras_held: bool = False


def camera_points(geometry: Geometry, observations: Observations) -> FloatArray:
    """Return the corners (V, N, 3) of every view in its camera's frame, metres."""
    place, camera = observations.place, observations.camera
    rig = geometry.corners @ np.swapaxes(geometry.board_R[place], 1, 2) + geometry.board_t[place][:, None]
    points: FloatArray = rig @ np.swapaxes(geometry.camera_R[camera], 1, 2) + geometry.camera_t[camera][:, None]
    return points


def residuals_of(geometry: Geometry, observations: Observations) -> FloatArray:
    """Return observed minus projected pixels (V, N, 2), 0 where a corner was not seen."""
    points = camera_points(geometry, observations)
    error = observations.uv - project(geometry.lenses[observations.camera][:, None], points)
    return np.where(observations.seen[..., None], error, 0.0)
