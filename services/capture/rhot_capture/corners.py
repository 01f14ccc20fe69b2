"""The four corners of a rectangular patch, from lines fitted to its sides.

A coarse quadrilateral of the mask gives the sides; across each of them the painted share crosses one half where the
true edge runs. A line through these crossings per side and the meeting points of neighbouring lines are the corners.
"""

from __future__ import annotations

from typing import Final

import cv2
import numpy as np
from numpy.typing import NDArray

from rhot_capture.color_table import ImageArray
from rhot_capture.subpixel import CoverageArray

FloatArray = NDArray[np.float64]

_POINTS_PER_SIDE: Final = 16
_SIDE_MARGIN: Final = 0.18
"""Share of a side left out at either end: corners are rounded by blur and by the brush."""
_SEARCH_PX: Final = (-3.0, 4.5)
"""How far inside and outside of the coarse side the edge is looked for; the mask's outline runs through the centres of
its outermost pixels, so the edge is rather outside."""
_STEPS: Final = 26
_MAX_SHIFT_PX: Final = 6.0
_MIN_SIDE_PX: Final = 7.0
_MAX_RESIDUAL_PX: Final = 0.6
_OUTLIER_PX: Final = 1.0
_AREA_TOLERANCE: Final = 0.15
_MAX_CONVERGENCE: Final = 0.2
"""How far opposite sides of a seen rectangle may differ, as a share of their length: 0.04 m at 0.3 m converge by 0.13;
more tells of a side that is no side but the edge of what hides a corner."""
_PLACES: Final = np.linspace(_SIDE_MARGIN, 1.0 - _SIDE_MARGIN, _POINTS_PER_SIDE)
_OFFSETS: Final = np.linspace(*_SEARCH_PX, _STEPS)
_NEXT: Final = np.array([1, 2, 3, 0])
_BEFORE: Final = np.array([3, 0, 1, 2])


def find_corners(share: CoverageArray, mask: ImageArray) -> FloatArray | None:
    """Return the corners of a patch, or None when the blob is not a quadrilateral that can be trusted.

    Args:
        share: (h, w) float32, painted share per pixel.
        mask: (h, w) uint8, 255 inside.

    Returns:
        (4, 2) float64, pixels in the window, clockwise as seen in the image; the first is the one nearest to the
        window's upper left (least u + v).
    """
    coarse = _coarse_quadrilateral(mask)
    if coarse is None:
        return None
    corners = _refine(share, coarse)
    if corners is None or np.max(np.linalg.norm(corners - coarse, axis=1)) > _MAX_SHIFT_PX:
        return None
    sides = corners[_NEXT] - corners
    difference = np.linalg.norm(sides[:2] + sides[2:], axis=1)
    if np.any(difference > _MAX_CONVERGENCE * np.maximum(*np.linalg.norm(sides, axis=1).reshape(2, 2))):
        return None
    area = _signed_area(corners)
    painted = float(share.sum())
    if abs(area - painted) > _AREA_TOLERANCE * painted:
        return None
    return corners


def _refine(share: CoverageArray, corners: FloatArray) -> FloatArray | None:
    """Return the meeting points of the lines fitted along four sides; side k runs from corner k to corner k + 1."""
    along = corners[_NEXT] - corners
    length = np.sqrt(np.einsum("ij,ij->i", along, along))
    along = along / length[:, None]
    outward = np.column_stack([along[:, 1], -along[:, 0]])
    distances = length[:, None] * _PLACES
    samples = (
        corners[:, None, None, :]
        + distances[:, :, None, None] * along[:, None, None, :]
        + _OFFSETS[None, None, :, None] * outward[:, None, None, :]
    ).astype(np.float32)
    flat = samples.reshape(4 * _POINTS_PER_SIDE, _STEPS, 2)
    profile = np.asarray(
        cv2.remap(share, flat[..., 0], flat[..., 1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    ).reshape(4, _POINTS_PER_SIDE, _STEPS)
    usable = (profile[..., 0] > 0.75) & (profile[..., -1] < 0.25)
    # The painted length along the profile ends at the edge: exact for any symmetric blur.
    step = _OFFSETS[1] - _OFFSETS[0]
    edge = _OFFSETS[0] + step * (profile.sum(axis=-1) - 0.5 * (profile[..., 0] + profile[..., -1]))
    fitted = _fit_lines(distances, edge, usable)
    if fitted is None:
        return None
    # edge = intercept + slope · distance, so the line runs through corner + intercept · outward.
    intercept, slope = fitted
    origin = corners + intercept[:, None] * outward
    direction = along + slope[:, None] * outward
    return _meeting_points(origin[_BEFORE], direction[_BEFORE], origin, direction)


def _fit_lines(x: FloatArray, y: FloatArray, usable: NDArray[np.bool_]) -> tuple[FloatArray, FloatArray] | None:
    """Fit y = intercept + slope · x in each row, twice, the second time without what lies far off."""
    for _ in range(2):
        weights = usable.astype(np.float64)
        total = weights.sum(axis=1)
        if np.any(total < _POINTS_PER_SIDE // 2):
            return None
        mean_x = (weights * x).sum(axis=1) / total
        mean_y = (weights * y).sum(axis=1) / total
        centred = x - mean_x[:, None]
        slope = (weights * centred * y).sum(axis=1) / (weights * centred**2).sum(axis=1)
        intercept = mean_y - slope * mean_x
        residual = np.abs(y - intercept[:, None] - slope[:, None] * x)
        usable &= residual <= _OUTLIER_PX
    if np.any((weights * residual).sum(axis=1) > _MAX_RESIDUAL_PX * total):
        return None
    return intercept, slope


def _meeting_points(
    origin_1: FloatArray, direction_1: FloatArray, origin_2: FloatArray, direction_2: FloatArray
) -> FloatArray | None:
    """Return where lines meet pairwise, (N, 2); None when some are parallel."""
    cross = direction_1[:, 0] * direction_2[:, 1] - direction_1[:, 1] * direction_2[:, 0]
    if np.any(np.abs(cross) < 1e-6):
        return None
    between = origin_2 - origin_1
    along = (between[:, 0] * direction_2[:, 1] - between[:, 1] * direction_2[:, 0]) / cross
    meeting: FloatArray = origin_1 + along[:, None] * direction_1
    return meeting


def _coarse_quadrilateral(mask: ImageArray) -> FloatArray | None:
    contours, _ = cv2.findContours(mask, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
    hull = cv2.convexHull(max(contours, key=cv2.contourArea))
    perimeter = cv2.arcLength(hull, True)
    quadrilateral: FloatArray | None = None
    for tolerance in (0.02, 0.04, 0.06, 0.09, 0.12):
        polygon = cv2.approxPolyDP(hull, tolerance * perimeter, True)
        if len(polygon) <= 4:
            if len(polygon) == 4:
                quadrilateral = polygon.reshape(4, 2).astype(np.float64)
            break
    if quadrilateral is None:
        quadrilateral = np.asarray(cv2.boxPoints(cv2.minAreaRect(hull)), dtype=np.float64)
    if _signed_area(quadrilateral) < 0.0:
        quadrilateral = quadrilateral[::-1].copy()
    if np.min(np.linalg.norm(quadrilateral - quadrilateral[_NEXT], axis=1)) < _MIN_SIDE_PX:
        return None
    return np.roll(quadrilateral, -int(np.argmin(quadrilateral.sum(axis=1))), axis=0)


def _signed_area(corners: FloatArray) -> float:
    """Area of a polygon, positive when clockwise as seen (v points down)."""
    following = corners[_NEXT]
    return 0.5 * float(np.sum(corners[:, 0] * following[:, 1] - following[:, 0] * corners[:, 1]))
