"""The four corners of a rectangular patch in space.

Each camera lists them in cyclic order from a corner of its own choosing, so the pairing between two cameras is one of
four shifts: the right one is the one whose corners agree best in the reprojection error and whose sides have the
patch's size.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from rhot.camera import CameraModel
from rhot.messages import MarkerFrame, Position
from rhot.rig import MarkerConfig
from rhot_fusion.triangulate import Prior, Triangulation, Views

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
        self._triangulation = Triangulation(cameras)
        self._focal_px = float(np.mean([camera.K[0, 0] for camera in cameras]))
        self._seen: dict[tuple[str, int], _Seen] = {}

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
            name: of the marker.
            xy: (C, 2) where each camera sees the patch's centre at t_s; NaN = it does not.
            position: (3,) the published point; the corners are placed around it.
            t_s: the moment.
        """
        if name not in self._sizes:
            return None
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
        stacked = np.full((len(self._cameras), 16, 2), np.nan)
        used = np.zeros((len(self._cameras), 16), dtype=bool)
        stacked[first] = np.tile(first_xy, (4, 1))
        stacked[second] = second_xy[_ORDERS].reshape(16, 2)
        used[[first, second]] = True
        nothing = Prior(np.full((16, 3), np.nan), np.ones(16))
        solution = self._triangulation.solve(Views(stacked, used), nothing, 1.0 / self._focal_px)
        quads = solution.position.reshape(4, 4, 3)
        residual_px = solution.residual.reshape(4, 4).max(axis=1) * self._focal_px
        misfit = np.array([self._side_misfit(name, quad) for quad in quads])
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

    def _side_misfit(self, name: str, quad: FloatArray) -> float:
        """Return the largest relative error of the four sides, in whichever order of the two sizes fits better."""
        if not np.isfinite(quad).all():
            return float("inf")
        sides = np.linalg.norm(np.roll(quad, -1, axis=0) - quad, axis=1)
        width, length = self._sizes[name]
        fits = [
            float(np.abs(sides / np.array([first, second, first, second]) - 1.0).max())
            for first, second in ((width, length), (length, width))
        ]
        return min(fits)
