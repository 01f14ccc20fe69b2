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
_ROUNDS: Final = 2
_MAX_SHIFT_PX: Final = 6.0
_MIN_SIDE_PX: Final = 7.0
_MAX_RESIDUAL_PX: Final = 0.8
_AREA_TOLERANCE: Final = 0.15


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
    corners = coarse
    # The second round samples straight across the sides that the first one found.
    for _ in range(_ROUNDS):
        refined = _refine(share, corners)
        if refined is None or np.max(np.linalg.norm(refined - coarse, axis=1)) > _MAX_SHIFT_PX:
            return None
        corners = refined
    area = _signed_area(corners)
    painted = float(share.sum())
    if abs(area - painted) > _AREA_TOLERANCE * painted:
        return None
    return corners


def _refine(share: CoverageArray, corners: FloatArray) -> FloatArray | None:
    lines = [_fit_side(share, corners[side], corners[(side + 1) % 4]) for side in range(4)]
    fitted = [line for line in lines if line is not None]
    if len(fitted) < 4:
        return None
    # Side k runs from corner k to corner k + 1, so corner k is where sides k − 1 and k meet.
    crossings = np.array([np.cross(fitted[side - 1], fitted[side]) for side in range(4)])
    if np.any(np.abs(crossings[:, 2]) < 1e-9):
        return None
    refined: FloatArray = crossings[:, :2] / crossings[:, 2:]
    return refined


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
    if np.min(np.linalg.norm(quadrilateral - np.roll(quadrilateral, -1, axis=0), axis=1)) < _MIN_SIDE_PX:
        return None
    return np.roll(quadrilateral, -int(np.argmin(quadrilateral.sum(axis=1))), axis=0)


def _signed_area(corners: FloatArray) -> float:
    """Area of a polygon, positive when clockwise as seen (v points down)."""
    u, v = corners.T
    return 0.5 * float(np.sum(u * np.roll(v, -1) - np.roll(u, -1) * v))


def _fit_side(share: CoverageArray, start: FloatArray, end: FloatArray) -> FloatArray | None:
    """Return the line (a, b, c) with a·u + b·v + c = 0 along one side."""
    along = end - start
    length = float(np.linalg.norm(along))
    along = along / length
    outward = np.array([along[1], -along[0]])
    distances = np.linspace(_SIDE_MARGIN * length, (1.0 - _SIDE_MARGIN) * length, _POINTS_PER_SIDE)
    steps = np.linspace(*_SEARCH_PX, _STEPS)
    samples = (start + distances[:, None] * along)[:, None, :] + steps[None, :, None] * outward
    profile = cv2.remap(
        share,
        samples[..., 0].astype(np.float32),
        samples[..., 1].astype(np.float32),
        cv2.INTER_LINEAR,
        borderMode=cv2.BORDER_REPLICATE,
    )
    # The painted length along the profile ends at the edge: exact for any symmetric blur.
    step = steps[1] - steps[0]
    painted = step * (profile.sum(axis=1) - 0.5 * (profile[:, 0] + profile[:, -1]))
    usable = (profile[:, 0] > 0.75) & (profile[:, -1] < 0.25)
    if np.count_nonzero(usable) < _POINTS_PER_SIDE // 2:
        return None
    offsets = _SEARCH_PX[0] + painted[usable]
    edge = start + distances[usable, None] * along + offsets[:, None] * outward
    direction = cv2.fitLine(edge.astype(np.float32), cv2.DIST_HUBER, 0, 0.01, 0.01).reshape(4).astype(np.float64)
    normal = np.array([-direction[1], direction[0]])
    offset = -float(normal @ direction[2:])
    residual = float(np.median(np.abs(edge @ normal + offset)))
    if residual > _MAX_RESIDUAL_PX:
        return None
    return np.array([normal[0], normal[1], offset])
