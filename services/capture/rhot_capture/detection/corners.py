"""Find the four corners of a rectangular patch from lines fitted to its sides.

A coarse quadrilateral is fitted to the outline. Along profiles across each side, the edge is located from the painted
shares. A line is fitted to the edge points of each side; the corners are the intersections of adjacent lines.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from itertools import pairwise
from typing import Final, cast

import cv2
import numpy as np
from numpy.typing import NDArray

from rhot.arrays import FloatArray
from rhot_capture.detection.blob import ContourArray
from rhot_capture.detection.subpixel.windows import CoverageArray, Shares

Point = tuple[float, float]

_POINTS_PER_SIDE: Final = 12
"""Number of profiles across each side; chosen."""
_SIDE_MARGIN: Final = 0.17
"""Share of a side omitted at either end: corners are rounded by blur and by the brush."""
_SEARCH_PX: Final = (-3.0, 5.5)
"""Range of a profile from inside to outside of the coarse side; asymmetric because the outline runs through the centres
of the outermost pixels, so that the edge is usually outside of it."""
_STEPS: Final = 12
"""Samples per profile, 0.8 pixels apart."""
_MAX_SHIFT_PX: Final = 6.0
"""Largest distance of a corner from that of the coarse polygon; slightly more than the end of the profiles."""
_MAX_RESIDUAL_PX: Final = 0.6
_OUTLIER_PX: Final = 1.0
"""Limits of an edge point's residual. A side is accepted if all residuals are below the first, or if the mean is and
none exceeds the second; points beyond the second are removed. Chosen."""
_POSITIONS: Final = np.linspace(_SIDE_MARGIN, 1.0 - _SIDE_MARGIN, _POINTS_PER_SIDE)
"""Positions of the profiles, as shares of a side's length."""
_POWERS: Final = np.vander(_POSITIONS, 3, increasing=True)
_LINEAR: Final = np.ascontiguousarray(_POWERS[:, :2].T)
_FIT: Final = np.linalg.pinv(_LINEAR)
"""Maps edges (4, _POINTS_PER_SIDE) to intercepts and slopes (4, 2), if all points are used."""
_STEP_PX: Final = (_SEARCH_PX[1] - _SEARCH_PX[0]) / (_STEPS - 1)
_TRAPEZIUM: Final = np.full(_STEPS, _STEP_PX, np.float32)
_TRAPEZIUM[[0, -1]] *= 0.5


def _sampling() -> CoverageArray:
    """Return the matrix that maps four corners and four outward normals (8, 2) to sample positions, pixels.

    Returns:
        (4 · _POINTS_PER_SIDE · _STEPS, 8) float32.
    """
    parts = np.zeros((4, _POINTS_PER_SIDE, _STEPS, 8), np.float32)
    for side in range(4):
        parts[side, :, :, side] = 1.0 - _POSITIONS[:, None]
        parts[side, :, :, (side + 1) % 4] = _POSITIONS[:, None]
        parts[side, :, :, 4 + side] = np.linspace(*_SEARCH_PX, _STEPS)
    return parts.reshape(-1, 8)


_SAMPLING: Final = _sampling()


def find_corners(
    shares: Shares, outline: ContourArray, shift: Point, area: float, expected: Sequence[Point] | None = None
) -> FloatArray | None:
    """Return the corners of a patch, or None if the blob is not a reliable quadrilateral.

    Args:
        shares: painted shares of its window.
        outline: (n, 1, 2) int32, of the blob.
        shift: x and y, pixels, from the outline's coordinates to those of the window.
        area: painted area, square pixels.
        expected: predicted corners, clockwise, pixels in the window; saves fitting the coarse quadrilateral, which
            takes a third of the time.

    Returns:
        (4, 2) float64, pixels in the window, clockwise in the image, starting with the one nearest to the window's
        upper left (smallest u + v).
    """
    if expected is not None:
        corners = _corners_near(shares, _from_upper_left(expected), area)
        if corners is not None:
            return corners
    coarse = _coarse_quadrilateral(outline, shift)
    return None if coarse is None else _corners_near(shares, coarse, area)


def _corners_near(shares: Shares, coarse: Sequence[Point], area: float) -> FloatArray | None:
    """Return the corners near those of a coarse quadrilateral; see `find_corners`."""
    corners = _refine(shares, coarse)
    if corners is None or max(map(math.dist, corners, coarse)) > _MAX_SHIFT_PX:
        return None
    (a, b, c, d), lengths = _sides(corners)
    for (x1, y1), (x2, y2), longest in ((a, c, max(lengths[0::2])), (b, d, max(lengths[1::2]))):
        # Largest difference between opposite sides, as a share of their length: with 0.04 m at 0.3 m
        # perspective causes 0.13. A larger one indicates that a side is the edge of an object that occludes a
        # corner.
        if math.hypot(x1 + x2, y1 + y2) > 0.2 * longest:
            return None
    # Largest relative difference between the area of the corners and the blob's; chosen.
    if abs(_signed_area(corners) - area) > 0.15 * area:
        return None
    return np.array(corners)


def _sides(corners: Sequence[Point]) -> tuple[list[Point], list[float]]:
    """Return the vectors along the sides, side k from corner k to corner k + 1, and their lengths."""
    (ax, ay), (bx, by), (cx, cy), (dx, dy) = corners
    along = [(bx - ax, by - ay), (cx - bx, cy - by), (dx - cx, dy - cy), (ax - dx, ay - dy)]
    return along, [math.hypot(x, y) for x, y in along]


def _refine(shares: Shares, corners: Sequence[Point]) -> list[Point] | None:
    """Return the intersections of the lines fitted to four sides."""
    along, lengths = _sides(corners)
    outward = [(y / length, -x / length) for (x, y), length in zip(along, lengths, strict=True)]
    on_grid = [*map(shares.on_grid, corners), *[(u / shares.scale, v / shares.scale) for u, v in outward]]
    samples = (_SAMPLING @ np.array(on_grid, np.float32)).reshape(4 * _POINTS_PER_SIDE, _STEPS, 2)
    profile = shares.at(samples)
    # The integral of the painted share along a profile gives the edge: exact for any symmetric blur.
    length = (profile @ _TRAPEZIUM).reshape(4, -1)
    fitted = _fit_lines(length, ((profile[:, 0] > 0.75) & (profile[:, -1] < 0.25)).reshape(4, -1))
    if fitted is None:
        return None
    # edge = start of the search + intercept + slope · position, so the line runs from corner + (start + intercept) ·
    # outward, which shifts by slope.
    start = _SEARCH_PX[0]
    lines = [
        (x + (start + first) * u, y + (start + first) * v, dx + slope * u, dy + slope * v)
        for (x, y), (dx, dy), (u, v), (first, slope) in zip(corners, along, outward, fitted, strict=True)
    ]
    return _intersections(lines)


def _fit_lines(edge: CoverageArray, usable: NDArray[np.bool_]) -> list[tuple[float, float]] | None:
    """Fit edge = intercept + slope · position to each side, repeatedly without outliers; None if a side does not fit.

    Args:
        edge: (4, _POINTS_PER_SIDE) float32, pixels.
        usable: (4, _POINTS_PER_SIDE), which points to use.
    """
    if usable.all():
        fits = edge @ _FIT
        if np.abs(edge - fits @ _LINEAR).max() <= _MAX_RESIDUAL_PX:
            return cast(list[tuple[float, float]], fits.tolist())
    weights = usable.astype(np.float64)
    while True:
        sums = (np.concatenate([weights, weights * edge]) @ _POWERS).tolist()
        lines = []
        for (n, s, ss), (t, st, _) in zip(sums[:4], sums[4:], strict=True):
            if n < _POINTS_PER_SIDE // 2:
                return None
            slope = (n * st - s * t) / (n * ss - s * s)
            lines.append(((t - slope * s) / n, slope))
        residual = np.abs(edge - np.array(lines) @ _LINEAR) * weights
        worst = residual.max()
        if worst <= _MAX_RESIDUAL_PX:
            return lines
        if worst <= _OUTLIER_PX:
            means = residual.sum(axis=1) / weights.sum(axis=1)
            return lines if means.max() <= _MAX_RESIDUAL_PX else None
        weights *= residual <= _OUTLIER_PX


def _intersections(lines: Sequence[tuple[float, float, float, float]]) -> list[Point] | None:
    """Return the intersection of each line (a point and a direction) with its predecessor; None if two are parallel."""
    points = []
    for (x1, y1, dx1, dy1), (x2, y2, dx2, dy2) in pairwise([lines[-1], *lines]):
        cross = dx1 * dy2 - dy1 * dx2
        if abs(cross) < 1e-6:
            return None
        along = ((x2 - x1) * dy2 - (y2 - y1) * dx2) / cross
        points.append((x1 + along * dx1, y1 + along * dy1))
    return points


def _coarse_quadrilateral(outline: ContourArray, shift: Point) -> list[Point] | None:
    hull = cv2.convexHull(outline)
    perimeter = cv2.arcLength(hull, True)
    polygon = hull
    for tolerance in (0.02, 0.04, 0.06, 0.09, 0.12):
        polygon = cv2.approxPolyDP(hull, tolerance * perimeter, True)
        if len(polygon) <= 4:
            break
    if len(polygon) != 4:
        polygon = cv2.boxPoints(cv2.minAreaRect(hull))
    shift_x, shift_y = shift
    corners = [(x + shift_x, y + shift_y) for x, y in polygon.reshape(4, 2).tolist()]
    if _signed_area(corners) < 0.0:
        corners.reverse()
    # Chosen: the profiles of either adjacent side extend 3 pixels into a side.
    if min(_sides(corners)[1]) < 7.0:
        return None
    return _from_upper_left(corners)


def _from_upper_left(corners: Sequence[Point]) -> list[Point]:
    """Return corners in their order, starting with the one nearest to the upper left."""
    sums = [x + y for x, y in corners]
    first = sums.index(min(sums))
    return [*corners[first:], *corners[:first]]


def _signed_area(corners: Sequence[Point]) -> float:
    """Return a quadrilateral's area, positive if clockwise (v down): half of its diagonals' cross product."""
    (ax, ay), (bx, by), (cx, cy), (dx, dy) = corners
    return 0.5 * ((cx - ax) * (dy - by) - (cy - ay) * (dx - bx))
