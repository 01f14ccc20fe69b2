"""The plane that the depth image sees inside a marker.

A stereo camera's noise is even in disparity, hence in inverse depth, not in depth (σ_z = z²·σ). With normalised image
coordinates (x, y) = (X/Z, Y/Z) the plane n·X = d is linear there:

    1/z = a · (x, y, 1),        a = n / d.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import cv2
import numpy as np
from numpy.typing import NDArray

from rhot.arrays import FloatArray
from rhot.geometry.camera import CameraModel
from rhot.geometry.hull import Region
from rhot_feet.frames import DepthImage

# The floor in the depth image.
#
# A plane n·X = d is linear in inverse depth, 1/z = a · (x, y, 1) with a = n/d (see `fit_depth_plane`), where the noise
# is the same near and far. A point X in front of it stands (1 − a·X) / |a| above it.

_SAMPLES: Final = 1500
"""Points that vote; chosen."""
_TRIALS: Final = 80
"""Planes through three random points that are tried. With half of the points on the floor all of them miss it once in
40,000 times, with a quarter in three of ten pictures; the floor of the picture before is tried, too."""
_NOISE: Final = 0.01
"""Inverse depth, 1/m: 10 mm at 1 m, 40 mm at 2 m; floors are not flat and lenses not perfect."""
_FLOOR_MIN_SHARE: Final = 0.15
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
        if near.mean() < _FLOOR_MIN_SHARE:
            return None
        coefficients = np.asarray(np.linalg.lstsq(A[near], inverse[near], rcond=None)[0], dtype=np.float64)
    below = float((inverse - A @ coefficients < -_BELOW).mean())
    if below > _MAX_BELOW or not coefficients.any():
        return None
    floor = FloorPlane(coefficients)
    if up_camera is not None and float(floor.up @ up_camera) < _MAX_TILT_COSINE:
        return None
    return floor


# From depth pixels to points.

Mask = NDArray[np.bool_]

FINE_PX: Final = 2
"""Distance of the pixels that feet are cut out of: the camera's depth is decimated by two, there is nothing between."""
COARSE_PX: Final = 12
"""Distance of the pixels that the floor is fitted to."""


@dataclass(frozen=True, slots=True)
class PointGrid:
    """The points of a region, one for every few pixels.

    Attributes:
        region: of the picture.
        points: (h, w, 3) metres, camera frame; meaningless where not valid.
        valid: (h, w) there is a believable depth.
    """

    region: Region
    points: FloatArray
    valid: Mask


class PixelRays:
    """The viewing directions (x, y, 1) of a camera's pixels, kept because lenses are slow to undo."""

    def __init__(self, camera: CameraModel, stride_px: int) -> None:
        """Undo the lens once.

        Args:
            camera: the lens.
            stride_px: distance of the pixels.
        """
        u, v = np.meshgrid(np.arange(0, camera.width, stride_px), np.arange(0, camera.height, stride_px))
        self._stride = stride_px
        pixels = np.column_stack([u.ravel(), v.ravel()]).astype(np.float64)
        self.camera = camera
        self._xy = camera.undistort(pixels).reshape(*u.shape, 2)

    def points(self, depth_mm: DepthImage, region: Region, depth_range_m: tuple[float, float]) -> PointGrid:
        """Return the points of a region.

        Args:
            depth_mm: (H, W) depth image.
            region: of the picture.
            depth_range_m: nearest and farthest depth that is believed.
        """
        stride = self._stride
        left, top = region.left // stride, region.top // stride
        right, bottom = -(-region.right // stride), -(-region.bottom // stride)
        z = 1e-3 * depth_mm[::stride, ::stride][top:bottom, left:right].astype(np.float64)
        xy = self._xy[top:bottom, left:right]
        points = np.empty((*z.shape, 3))
        points[..., :2], points[..., 2] = xy * z[..., None], z
        snapped = Region(left * stride, top * stride, right * stride, bottom * stride)
        return PointGrid(snapped, points, (z >= depth_range_m[0]) & (z <= depth_range_m[1]))


INVERSE_DEPTH_SIGMA: Final = 0.004
"""Per pixel, 1/m: a D435 at 848x480 (focal length 425 px, baseline 50 mm) with 0.085 px of disparity noise."""
CORRELATED_PX: Final = 50.0
"""Neighbouring depths share their stereo window and the smoothing: about so many pixels count as one."""
SCALE_SIGMA: Final = 0.003
"""A depth camera's own error of scale, as a share of the distance; no picture averages it away."""
_MIN_PIXELS: Final = 20
_MIN_SHARE: Final = 0.3
"""Fewer pixels with depth, or a smaller share of those inside, give no plane. Chosen."""
_CLIP: Final = 3.0
"""Standard deviations from the plane beyond which a pixel is an outlier."""


@dataclass(frozen=True, slots=True)
class DepthPlane:
    """A plane in front of the camera.

    Attributes:
        coefficients: (3,) a, with 1/z = a · (x, y, 1), 1/m.
        covariance: (3, 3) of them.
        share: 0 to 1, pixels that agree with the plane among all inside the outline.
    """

    coefficients: FloatArray
    covariance: FloatArray
    share: float

    def depth_m(self, xy: FloatArray) -> float:
        """Return the depth at normalised coordinates (2,), metres; infinite where the plane is not in front."""
        inverse = float(self.coefficients @ (xy[0], xy[1], 1.0))
        return 1.0 / inverse if inverse > 0.0 else float("inf")

    def depth_sigma_m(self, xy: FloatArray) -> float:
        """Return the standard deviation of `depth_m` at normalised coordinates (2,), metres."""
        direction = np.array([xy[0], xy[1], 1.0])
        return self.depth_m(xy) ** 2 * float(np.sqrt(direction @ self.covariance @ direction))


def fit_depth_plane(
    depth_mm: DepthImage, outline: FloatArray, camera: CameraModel, depth_range_m: tuple[float, float]
) -> DepthPlane | None:
    """Fit the plane of the depths inside an outline; None where there are too few or they form none.

    Args:
        depth_mm: (H, W) depth image.
        outline: (N, 2) convex, pixels; a rim is left out, because depth edges are ragged.
        camera: its lens.
        depth_range_m: nearest and farthest depth that is believed.
    """
    centre = outline.mean(axis=0)
    # The outline is shrunk by this factor: at its rim depth mixes with what lies behind. Chosen.
    inner = centre + 0.8 * (outline - centre)
    height, width = depth_mm.shape
    left, top = np.maximum(np.floor(inner.min(axis=0)), 0).astype(int)
    right, bottom = np.minimum(np.ceil(inner.max(axis=0)) + 1, (width, height)).astype(int)
    if right - left < 2 or bottom - top < 2:
        return None
    mask = np.zeros((bottom - top, right - left), dtype=np.uint8)
    cv2.fillConvexPoly(mask, np.rint(inner - (left, top)).astype(np.int32), 1)
    inside = np.flatnonzero(mask)
    # Pixels that are used: neighbours are correlated, more of them tell little. Chosen.
    stride = max(1, len(inside) // 250)
    inside = inside[::stride]
    z = 1e-3 * depth_mm[top:bottom, left:right].ravel()[inside].astype(np.float64)
    valid = (z >= depth_range_m[0]) & (z <= depth_range_m[1])
    if valid.sum() * stride < _MIN_PIXELS or valid.mean() < _MIN_SHARE:
        return None
    pixels = np.column_stack([inside % mask.shape[1] + left, inside // mask.shape[1] + top])[valid]
    return _robust_plane(camera.undistort(pixels.astype(np.float64)), 1.0 / z[valid], len(inside), stride)


def _robust_plane(xy: FloatArray, inverse: FloatArray, count: int, stride: int) -> DepthPlane | None:
    A = np.column_stack([xy, np.ones(len(xy))])
    limit = _CLIP * INVERSE_DEPTH_SIGMA
    used = np.abs(inverse - np.median(inverse)) < 4.0 * limit + 0.1 * np.median(inverse)
    coefficients: FloatArray = np.zeros(3)
    for _ in range(3):
        if used.sum() < 6 or used.mean() < _MIN_SHARE:
            return None
        normal = A[used].T @ A[used]
        coefficients = np.asarray(np.linalg.solve(normal + 1e-12 * np.eye(3), A[used].T @ inverse[used]))
        residual = inverse - A @ coefficients
        sigma = max(INVERSE_DEPTH_SIGMA, 1.4826 * float(np.median(np.abs(residual[used]))))
        used = np.abs(residual) < _CLIP * sigma
    if used.sum() < 6:
        return None
    variance = max(INVERSE_DEPTH_SIGMA**2, float(np.mean(residual[used] ** 2)))
    normal = A[used].T @ A[used]
    # Independent measurements are fewer than pixels, by the area that shares one stereo window.
    shared = variance * max(1.0, CORRELATED_PX / stride)
    covariance: FloatArray = shared * np.asarray(np.linalg.inv(normal + 1e-9 * np.eye(3)), dtype=np.float64)
    covariance = covariance + SCALE_SIGMA**2 * np.outer(coefficients, coefficients)
    if coefficients @ A.mean(axis=0) <= 0.0:
        return None
    return DepthPlane(coefficients, covariance, float(used.sum()) / count)
