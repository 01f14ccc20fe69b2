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

from rhot.arrays import FloatArray
from rhot.geometry.camera import CameraModel
from rhot_feet.frames import DepthImage

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
