"""The four corners of a rectangular patch in space.

Each camera lists them in cyclic order from a corner of its own choosing, so the pairing between two cameras is one of
four shifts: the right one is the one whose corners agree in the reprojection error and whose sides have the patch's
size. With any other one the rays miss each other by the size of the patch; the shift that fitted last is tried first.

Plain numbers: for four corners numpy's calls cost more than the sums.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from rhot.camera import CameraModel
from rhot.messages import MarkerFrame, PixelPoint, Position
from rhot.rig import MarkerConfig

FloatArray = NDArray[np.float64]

_NEWEST_S = 0.05
_SIDE_TOLERANCE = 0.35
"""Sides may differ from the patch's by this share: paint has soft edges and depth is noisy."""
_RESIDUAL_PX = 3.0

Vector = tuple[float, float, float]
Corners = tuple[Position, Position, Position, Position]


@dataclass(frozen=True, slots=True)
class _View:
    """A camera.

    Attributes:
        center: metres, rig frame.
        axis: direction in which it looks.
        aside: (2, 3) the x and y axes of its picture, rig frame.
    """

    center: Vector
    axis: Vector
    aside: FloatArray


@dataclass(frozen=True, slots=True)
class _Seen:
    """Corners in one frame of one camera.

    Attributes:
        t_s: time of the patch's own row.
        rays: to each corner less the ray to the marker's centre, rig frame, at depth 1.
    """

    t_s: float
    rays: list[list[float]]


class PatchCorners:
    """Keeps each camera's newest corners of each patch and triangulates them around the patch's point.

    Attributes:
        names: the markers that are rectangles of known size.
    """

    def __init__(self, markers: Mapping[str, MarkerConfig], cameras: Sequence[CameraModel]) -> None:
        sizes = {
            name: sorted(marker.size_m) for name, marker in markers.items() if marker.kind == "patch" and marker.size_m
        }
        self.names = frozenset(sizes)
        self._sizes = {name: (width, length) for name, (width, length) in sizes.items()}
        self._cameras = list(cameras)
        self._views = [
            _View(_vector(camera.center), _vector(camera.R_camera_rig[2]), camera.R_camera_rig[:2])
            for camera in cameras
        ]
        self._focal_px = float(np.mean([camera.K[0, 0] for camera in cameras]))
        self._seen: dict[tuple[str, int], _Seen] = {}
        self._shift: dict[tuple[str, int, int], int] = {}

    def listed(self, camera: int, frame: MarkerFrame) -> dict[str, tuple[PixelPoint, ...]]:
        """Return centre and corners, pixels, of the patches of a frame that lie inside the picture as a whole."""
        model = self._cameras[camera]
        listed: dict[str, tuple[PixelPoint, ...]] = {}
        for name in self.names:
            marker = frame.markers.get(name)
            if marker is not None and marker.corners is not None:
                points = ((marker.u, marker.v), *marker.corners)
                if all(-0.5 < u < model.width - 0.5 and -0.5 < v < model.height - 0.5 for u, v in points):
                    listed[name] = points
        return listed

    def observe(self, camera: int, name: str, t_s: float, xy: FloatArray) -> None:
        """Take a patch's centre and corners (5, 2), normalised coordinates, seen at t_s."""
        rays = (xy[1:] - xy[0]) @ self._views[camera].aside
        self._seen[name, camera] = _Seen(t_s, rays.tolist())

    def solve(self, name: str, cameras: Sequence[int], position: Vector, t_s: float) -> Corners | None:
        """Return a patch's corners, metres, rig frame, in cyclic order, or None where the views do not agree on them.

        Args:
            name: of the marker, one of `names`.
            cameras: which cameras see the patch at t_s.
            position: the published point; the corners are placed around it.
            t_s: the moment.
        """
        views = [
            (camera, seen)
            for camera in cameras
            if (seen := self._seen.get((name, camera))) is not None and abs(t_s - seen.t_s) <= _NEWEST_S
        ]
        if len(views) < 2:
            return None
        (first, first_seen), (second, second_seen) = views[:2]
        a, b = self._views[first], self._views[second]
        d, e = _rays(a, position, first_seen.rays), _rays(b, position, second_seen.rays)
        last = self._shift.get((name, first, second), 0)
        for shift in (last, (last + 1) % 4, (last + 2) % 4, (last + 3) % 4):
            quad, gap = _meet(a.center, d, b.center, e[shift:] + e[:shift])
            depth = max(abs(_dot(quad[0], a.axis)), 1e-3)
            if 0.5 * gap / depth * self._focal_px <= _RESIDUAL_PX and self._fits(name, quad):
                self._shift[name, first, second] = shift
                return _around(quad, position)
        return None

    def clear(self) -> None:
        """Forget everything."""
        self._seen.clear()
        self._shift.clear()

    def _fits(self, name: str, quad: Sequence[Vector]) -> bool:
        """Tell whether the sides of a quad have the patch's size, in either order."""
        p, q, r, s = (math.dist(quad[corner - 1], quad[corner]) for corner in (1, 2, 3, 0))
        return any(
            max(abs(p / u - 1.0), abs(q / v - 1.0), abs(r / u - 1.0), abs(s / v - 1.0)) <= _SIDE_TOLERANCE
            for u, v in (self._sizes[name], self._sizes[name][::-1])
        )


def _vector(values: FloatArray) -> Vector:
    x, y, z = values.tolist()
    return (x, y, z)


def _dot(a: Vector, b: Vector) -> float:
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


def _rays(view: _View, position: Vector, offsets: Sequence[Sequence[float]]) -> list[Vector]:
    """Return the rays from a camera, at depth 1, that lie beside the one to a position by offsets."""
    x, y, z = position[0] - view.center[0], position[1] - view.center[1], position[2] - view.center[2]
    depth = max(_dot((x, y, z), view.axis), 1e-3)
    x, y, z = x / depth, y / depth, z / depth
    return [(x + i, y + j, z + k) for i, j, k in offsets]


def _meet(a: Vector, first: Sequence[Vector], b: Vector, second: Sequence[Vector]) -> tuple[list[Vector], float]:
    """Return where rays from a and from b come nearest to each other, metres, and the largest distance there.

    The middle of the shortest line between two rays (Hartley and Sturm, "Triangulation", 1997, section 3.1) is as good
    as a least-squares point for the shape of a patch, at a fraction of the cost.
    """
    way = (b[0] - a[0], b[1] - a[1], b[2] - a[2])
    places: list[Vector] = []
    largest = 0.0
    for d, e in zip(first, second, strict=True):
        dd, de, ee, dw, ew = _dot(d, d), _dot(d, e), _dot(e, e), _dot(d, way), _dot(e, way)
        # Parallel rays meet nowhere; the point is thrown far away and no side fits.
        det = max(dd * ee - de * de, 1e-12)
        s, t = (dw * ee - ew * de) / det, (dw * de - ew * dd) / det
        p = (a[0] + s * d[0], a[1] + s * d[1], a[2] + s * d[2])
        q = (b[0] + t * e[0], b[1] + t * e[1], b[2] + t * e[2])
        largest = max(largest, math.dist(p, q))
        places.append((0.5 * (p[0] + q[0]), 0.5 * (p[1] + q[1]), 0.5 * (p[2] + q[2])))
    return places, largest


def _around(quad: Sequence[Vector], position: Vector) -> Corners:
    """Return a quad moved so that its middle lies at a position."""
    x, y, z = (place - 0.25 * sum(axis) for place, axis in zip(position, zip(*quad, strict=True), strict=True))
    a, b, c, d = ((p[0] + x, p[1] + y, p[2] + z) for p in quad)
    return (a, b, c, d)
