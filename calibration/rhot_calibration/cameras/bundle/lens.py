"""The pinhole camera with Brown–Conrady distortion, projected together with its derivatives.

With (x, y) = (X/Z, Y/Z), bent to (x', y') by k1, k2, p1, p2 and k3 (`rhot.geometry.distortion`):

    u = fx · x' + cx
    v = fy · y' + cy
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np

from rhot.arrays import BoolArray, FloatArray, IntArray
from rhot.geometry.distortion import Distorted, distorted

# What bundle adjustment works with: observations, the geometry that is estimated, and what is known beforehand.


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


LENS_NAMES: Final = ("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2", "k3")
"""Order of a lens's parameters; the last five are OpenCV's order of distortion coefficients."""
LENS_SIZE: Final = len(LENS_NAMES)


def lens_of(K: FloatArray, distortion: FloatArray) -> FloatArray:
    """Return the parameters (9,) of a camera matrix (3, 3) and up to five coefficients."""
    lens = np.zeros(LENS_SIZE)
    lens[:4] = K[0, 0], K[1, 1], K[0, 2], K[1, 2]
    lens[4 : 4 + len(distortion)] = distortion
    return lens


def camera_matrix(lens: FloatArray) -> FloatArray:
    """Return K (3, 3), pixels, of a lens (9,)."""
    return np.array([[lens[0], 0.0, lens[2]], [0.0, lens[1], lens[3]], [0.0, 0.0, 1.0]])


def project(lens: FloatArray, points: FloatArray) -> FloatArray:
    """Return raw pixels (..., 2) of points (..., 3) in the camera frame; lens (..., 9) broadcasts."""
    return _project(lens, points)[0]


def project_with_derivatives(lens: FloatArray, points: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return pixels and how they change.

    Args:
        lens: (..., 9), leading dimensions broadcast against those of the points.
        points: (..., 3) metres, camera frame.

    Returns:
        Pixels (..., 2), their derivative by the lens (..., 2, 9) and by the point (..., 2, 3), pixels per metre.
    """
    uv, bent, (x, y, inverse_z) = _project(lens, points)
    r2, radial = bent.r2, bent.radial
    fx, fy = lens[..., 0], lens[..., 1]
    k1, k2, p1, p2, k3 = (lens[..., index] for index in range(4, 9))
    by_lens = np.zeros((*x.shape, 2, LENS_SIZE))
    by_lens[..., 0, 0], by_lens[..., 1, 1] = bent.xy[..., 0], bent.xy[..., 1]
    by_lens[..., 0, 2] = by_lens[..., 1, 3] = 1.0
    for axis, focal, along in ((0, fx, x), (1, fy, y)):
        by_lens[..., axis, 4] = focal * along * r2
        by_lens[..., axis, 5] = focal * along * r2**2
        by_lens[..., axis, 8] = focal * along * r2**3
    by_lens[..., 0, 6], by_lens[..., 0, 7] = fx * 2.0 * x * y, fx * (r2 + 2.0 * x**2)
    by_lens[..., 1, 6], by_lens[..., 1, 7] = fy * (r2 + 2.0 * y**2), fy * 2.0 * x * y
    slope = 2.0 * (k1 + 2.0 * k2 * r2 + 3.0 * k3 * r2**2)
    cross = slope * x * y + 2.0 * p1 * x + 2.0 * p2 * y
    u_x = fx * (radial + slope * x**2 + 2.0 * p1 * y + 6.0 * p2 * x)
    u_y = fx * cross
    v_x = fy * cross
    v_y = fy * (radial + slope * y**2 + 6.0 * p1 * y + 2.0 * p2 * x)
    by_point = np.empty((*x.shape, 2, 3))
    by_point[..., 0, 0], by_point[..., 0, 1] = u_x * inverse_z, u_y * inverse_z
    by_point[..., 1, 0], by_point[..., 1, 1] = v_x * inverse_z, v_y * inverse_z
    by_point[..., 0, 2] = -(u_x * x + u_y * y) * inverse_z
    by_point[..., 1, 2] = -(v_x * x + v_y * y) * inverse_z
    return uv, by_lens, by_point


def _project(lens: FloatArray, points: FloatArray) -> tuple[FloatArray, Distorted, tuple[FloatArray, ...]]:
    # A step of the optimiser may bring a point to the camera's plane for a moment; the step is refused then.
    z = np.where(np.abs(points[..., 2]) > 1e-6, points[..., 2], 1e-6)
    inverse_z = 1.0 / z
    x, y = points[..., 0] * inverse_z, points[..., 1] * inverse_z
    bent = distorted(x, y, [lens[..., index] for index in range(4, LENS_SIZE)])
    uv = bent.xy * lens[..., 0:2] + lens[..., 2:4]
    return uv, bent, (x, y, inverse_z)
