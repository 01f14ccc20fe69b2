"""The floor in the depth image.

A plane n·X = d is linear in inverse depth (see `depth_plane`), 1/z = a · (x, y, 1) with a = n/d, where the noise is the
same near and far. A point X in front of it stands (1 − a·X) / |a| above it.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np

from rhot.arrays import FloatArray
from rhot_feet.depth.points import PointGrid

_SAMPLES: Final = 1500
"""Points that vote; chosen."""
_TRIALS: Final = 80
"""Planes through three random points that are tried. With half of the points on the floor all of them miss it once in
40,000 times, with a quarter in three of ten pictures; the floor of the picture before is tried, too."""
_NOISE: Final = 0.01
"""Inverse depth, 1/m: 10 mm at 1 m, 40 mm at 2 m; floors are not flat and lenses not perfect."""
_MIN_SHARE: Final = 0.15
"""Of the pixels with depth; with less floor in sight no plane is believed."""
_MAX_BELOW: Final = 0.06
"""Of the pixels: nothing lies under the floor, so a plane with more than this under it is a table or a wall."""
_BELOW: Final = 0.04
"""Inverse depth, 1/m, by which a point has to be farther than a plane to count as under it."""
_MAX_TILT_COSINE: Final = float(np.cos(np.radians(20.0)))
"""A plane that is tilted further against gravity is no floor: ramps, and the headset's error. Chosen."""


@dataclass(frozen=True, slots=True)
class FloorPlane:
    """The floor, in the camera frame.

    Attributes:
        coefficients: (3,) a, 1/m.
    """

    coefficients: FloatArray

    @property
    def up(self) -> FloatArray:
        """(3,) unit vector out of the floor."""
        return -self.coefficients / float(np.linalg.norm(self.coefficients))

    def heights_m(self, points: FloatArray) -> FloatArray:
        """Return the heights (...,) of points (..., 3) above the floor, metres."""
        heights: FloatArray = (1.0 - points @ self.coefficients) / float(np.linalg.norm(self.coefficients))
        return heights

    def seen_from(self, T_old_new: FloatArray) -> FloorPlane:
        """Return the same floor in the frame of a camera that has moved; (4, 4) maps its new frame to its old one."""
        coefficients = T_old_new[:3, :3].T @ self.coefficients
        return FloorPlane(coefficients / (1.0 - float(self.coefficients @ T_old_new[:3, 3])))


def find_floor(
    grid: PointGrid, up_camera: FloatArray | None = None, previous: FloorPlane | None = None
) -> FloorPlane | None:
    """Return the lowest large plane; None when there is none in sight.

    Args:
        grid: points of the whole picture.
        up_camera: (3,) unit vector against gravity, camera frame; the floor lies across it.
        previous: the floor in the picture before, tried first.
    """
    points = grid.points[grid.valid]
    if len(points) < 50:
        return None
    points = points[:: max(1, len(points) // _SAMPLES)]
    inverse = 1.0 / points[:, 2]
    A = np.column_stack([points[:, :2] * inverse[:, None], np.ones(len(points))])
    if previous is not None:
        floor = _refined(A, inverse, previous.coefficients, up_camera)
        if floor is not None:
            return floor
    # The same trials for the same picture: results can be repeated.
    picks = np.random.default_rng(0).integers(0, len(points), (_TRIALS, 3))
    corners = A[picks]
    usable = np.abs(np.linalg.det(corners)) > 1e-5
    if not usable.any():
        return None
    planes = np.linalg.solve(corners[usable], inverse[picks[usable]][..., None])[..., 0]
    difference = inverse - planes @ A.T
    good = (np.abs(difference) < _NOISE).sum(axis=1) - 3.0 * (difference < -_BELOW).sum(axis=1)
    if up_camera is not None:
        good[(planes @ -up_camera) < _MAX_TILT_COSINE * np.linalg.norm(planes, axis=1)] = -np.inf
    best = int(np.argmax(good))
    return _refined(A, inverse, planes[best], up_camera) if np.isfinite(good[best]) else None


def _refined(
    A: FloatArray, inverse: FloatArray, coefficients: FloatArray, up_camera: FloatArray | None
) -> FloorPlane | None:
    near = np.empty(0, dtype=np.bool_)
    for limit in (3.0 * _NOISE, _NOISE, _NOISE):
        near = np.abs(inverse - A @ coefficients) < limit
        if near.mean() < _MIN_SHARE:
            return None
        coefficients = np.asarray(np.linalg.lstsq(A[near], inverse[near], rcond=None)[0], dtype=np.float64)
    below = float((inverse - A @ coefficients < -_BELOW).mean())
    if below > _MAX_BELOW or not coefficients.any():
        return None
    floor = FloorPlane(coefficients)
    if up_camera is not None and float(floor.up @ up_camera) < _MAX_TILT_COSINE:
        return None
    return floor
