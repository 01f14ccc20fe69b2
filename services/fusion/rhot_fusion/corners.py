"""The four corners of a rectangular patch in space.

Each camera lists them in cyclic order from a corner of its own choosing, so the pairing between two cameras is one of
four shifts: the right one is the one whose corners agree best in the reprojection error and whose sides have the
patch's size.
"""

from __future__ import annotations

from collections.abc import Container, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from rhot.camera import CameraModel
from rhot.messages import MarkerFrame, Position
from rhot.rig import MarkerConfig

FloatArray = NDArray[np.float64]

_NEWEST_S = 0.05
_SIDE_TOLERANCE = 0.35
"""Sides may differ from the patch's by this share: paint has soft edges and depth is noisy."""
_RESIDUAL_PX = 3.0
_ORDERS = np.array([[(corner + shift) % 4 for corner in range(4)] for shift in range(4)])

Corners = tuple[Position, Position, Position, Position]


@dataclass(frozen=True, slots=True)
class _Seen:
    """Corners in one frame of one camera.

    Attributes:
        t_s: time of the patch's own row.
        offsets: (4, 2) normalised coordinates, relative to the marker's centre.
    """

    t_s: float
    offsets: FloatArray


class PatchCorners:
    """Keeps each camera's newest corners of each patch and triangulates them with the patch's point."""

    def __init__(self, markers: Mapping[str, MarkerConfig], cameras: Sequence[CameraModel]) -> None:
        self._sizes = {
            name: sorted(marker.size_m) for name, marker in markers.items() if marker.kind == "patch" and marker.size_m
        }
        self._cameras = list(cameras)
        self._focal_px = float(np.mean([camera.K[0, 0] for camera in cameras]))
        self._seen: dict[tuple[str, int], _Seen] = {}

    @property
    def names(self) -> Container[str]:
        """The markers that are rectangles of known size."""
        return self._sizes

    def observe(self, camera: int, frame: MarkerFrame, frame_s: float) -> None:
        """Take the corners in a frame that came at frame_s."""
        for name in self._sizes:
            marker = frame.markers.get(name)
            if marker is None or marker.corners is None:
                continue
            pixels = np.array([(marker.u, marker.v), *marker.corners])
            if not self._cameras[camera].contains(pixels).all():
                continue
            xy = self._cameras[camera].undistort(pixels)
            t_s = frame_s if marker.t_ns is None else frame_s + (marker.t_ns - frame.t_ns) * 1e-9
            self._seen[name, camera] = _Seen(t_s, xy[1:] - xy[0])

    def solve(self, name: str, xy: FloatArray, position: FloatArray, t_s: float) -> Corners | None:
        """Return a patch's corners, metres, rig frame, in cyclic order, or None where the views do not agree on them.

        Args:
            name: of the marker, one of `names`.
            xy: (C, 2) where each camera sees the patch's centre at t_s; NaN = it does not.
            position: (3,) the published point; the corners are placed around it.
            t_s: the moment.
        """
        views = [
            (camera, seen.offsets + xy[camera])
            for camera in range(len(self._cameras))
            if np.isfinite(xy[camera, 0])
            and (seen := self._seen.get((name, camera))) is not None
            and abs(t_s - seen.t_s) <= _NEWEST_S
        ]
        if len(views) < 2:
            return None
        (first, first_xy), (second, second_xy) = views[:2]
        # All four pairings at once: (4 shifts, 4 corners, 3).
        quads, gap = self._meet(first, first_xy, second, second_xy[_ORDERS])
        depth = np.maximum(np.abs(quads[0, 0] @ self._cameras[first].R_camera_rig[2]), 1e-3)
        residual_px = 0.5 * gap.max(axis=1) / depth * self._focal_px
        misfit = self._side_misfit(name, quads)
        fits = (residual_px <= _RESIDUAL_PX) & (misfit <= _SIDE_TOLERANCE)
        if not fits.any():
            return None
        best = int(np.argmin(np.where(fits, residual_px / _RESIDUAL_PX + misfit / _SIDE_TOLERANCE, np.inf)))
        quad = quads[best] - quads[best].mean(axis=0) + position
        a, b, c, d = ((float(x), float(y), float(z)) for x, y, z in quad)
        return (a, b, c, d)

    def clear(self) -> None:
        """Forget everything."""
        self._seen.clear()

    def _meet(
        self, first: int, first_xy: FloatArray, second: int, second_xy: FloatArray
    ) -> tuple[FloatArray, FloatArray]:
        """Return where rays of two cameras come nearest to each other (..., 3), metres, and their distance (...) there.

        The middle of the shortest line between two rays (Hartley and Sturm, "Triangulation", 1997, section 3.1) is as
        good as a least-squares point for the shape of a patch, at a fraction of the cost.
        """
        a, b = self._cameras[first], self._cameras[second]
        d = first_xy @ a.R_camera_rig[:2] + a.R_camera_rig[2]
        e = second_xy @ b.R_camera_rig[:2] + b.R_camera_rig[2]
        way = b.center - a.center
        dd, de, ee = (d * d).sum(axis=-1), (d * e).sum(axis=-1), (e * e).sum(axis=-1)
        dw, ew = d @ way, e @ way
        # Parallel rays meet nowhere; the point is thrown far away and no side fits.
        det = np.maximum(dd * ee - de * de, 1e-12)
        p = a.center + ((dw * ee - ew * de) / det)[..., None] * d
        q = b.center + ((dw * de - ew * dd) / det)[..., None] * e
        miss = p - q
        return 0.5 * (p + q), np.sqrt((miss * miss).sum(axis=-1))

    def _side_misfit(self, name: str, quads: FloatArray) -> FloatArray:
        """Return the largest relative error (N,) of the sides of quads (N, 4, 3), in the better order of the sizes."""
        along = quads[:, (1, 2, 3, 0)] - quads
        sides = np.sqrt((along * along).sum(axis=2))
        width, length = self._sizes[name]
        orders = np.array([[width, length, width, length], [length, width, length, width]])
        misfit: FloatArray = np.abs(sides[:, None] / orders - 1.0).max(axis=2).min(axis=1)
        return misfit
