"""How the 2021 thesis saw feet: the marker's centre and the depth at it, or the nearest blob of depth.

Marker stage: OpenCV's ArUco detector as it comes, the mean of the four corners, the aligned depth at that pixel, and
the first of the two poses of the square. No gate: what is detected is believed.

Depth stage, for a marker that is not detected: the depth image within a band about the last depth, opening, contours,
the one nearest to the last pixel, and in it the valid pixel nearest to the contour's centre. The blob's position stands
for the foot's; the marker's offset from it is not known. The width of the band and the opening's kernel are ours: the
band keeps a whole foot and parts it from the floor behind it.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Final

import cv2
import numpy as np
from numpy.typing import NDArray

from rhot.arrays import FloatArray
from rhot.geometry.camera import CameraModel
from rhot.messages import Side

ColorImage = NDArray[np.uint8]
DepthImage = NDArray[np.uint16]

BAND_MM: Final = 100
_KERNEL: Final = np.ones((5, 5), np.uint8)


@dataclass(frozen=True, slots=True)
class ThesisFoot:
    """A foot as the thesis's camera stages report it.

    Attributes:
        position: (3,) metres, camera frame.
        stage: which of the two found it.
        R_camera_marker: (3, 3) first solution, marker stage only.
    """

    position: FloatArray
    stage: str
    R_camera_marker: FloatArray | None


@dataclass(frozen=True, slots=True)
class _Last:
    pixel: tuple[float, float]
    depth_mm: float


class ThesisFeet:
    """The camera stages of the thesis for both feet."""

    def __init__(self, dictionary: cv2.aruco.Dictionary, marker_ids: Mapping[Side, int], size_m: float) -> None:
        """Prepare.

        Args:
            dictionary: of the markers.
            marker_ids: foot to the number of its marker.
            size_m: side of a marker's black square.
        """
        self._detector = cv2.aruco.ArucoDetector(dictionary, cv2.aruco.DetectorParameters())
        self._ids = dict(marker_ids)
        half = 0.5 * size_m
        self._square = np.array([[-half, half, 0.0], [half, half, 0.0], [half, -half, 0.0], [-half, -half, 0.0]])
        self._last: dict[Side, _Last] = {}

    def start(self, side: Side, pixel: tuple[float, float], depth_mm: float) -> None:
        """Set the last position of a foot by hand: (u, v), pixels, and its depth."""
        self._last[side] = _Last(pixel, depth_mm)

    def detect(self, color: ColorImage, depth_mm: DepthImage, camera: CameraModel) -> dict[Side, ThesisFoot]:
        """Return the feet found in a picture with its aligned depth.

        Args:
            color: (H, W, 3) uint8 BGR.
            depth_mm: (H, W) uint16, 0 = none.
            camera: its lens.
        """
        corners, ids, _ = self._detector.detectMarkers(cv2.cvtColor(color, cv2.COLOR_BGR2GRAY))
        quads: dict[int, FloatArray] = {}
        if corners:
            for marker_id, quad in zip(np.asarray(ids, dtype=int).ravel().tolist(), corners, strict=True):
                quads.setdefault(int(marker_id), np.asarray(quad, dtype=np.float64).reshape(4, 2))
        feet: dict[Side, ThesisFoot] = {}
        for side, marker_id in self._ids.items():
            foot = None
            if marker_id in quads:
                foot = self._by_marker(side, quads[marker_id], depth_mm, camera)
            if foot is None and side in self._last:
                foot = self._by_depth(side, depth_mm, camera)
            if foot is not None:
                feet[side] = foot
        return feet

    def _by_marker(self, side: Side, quad: FloatArray, depth_mm: DepthImage, camera: CameraModel) -> ThesisFoot | None:
        u, v = quad.mean(axis=0)
        column, row = round(float(u)), round(float(v))
        if not (0 <= row < depth_mm.shape[0] and 0 <= column < depth_mm.shape[1]) or depth_mm[row, column] == 0:
            return None
        depth = float(depth_mm[row, column])
        self._last[side] = _Last((float(u), float(v)), depth)
        distortion = camera.distortion if camera.distortion.size else None
        solved, rotation, _ = cv2.solvePnP(self._square, quad, camera.K, distortion, flags=cv2.SOLVEPNP_IPPE_SQUARE)
        R = np.asarray(cv2.Rodrigues(rotation)[0], dtype=np.float64) if solved else None
        return ThesisFoot(_deproject((float(u), float(v)), depth, camera), "marker", R)

    def _by_depth(self, side: Side, depth_mm: DepthImage, camera: CameraModel) -> ThesisFoot | None:
        last = self._last[side]
        low, high = max(1.0, last.depth_mm - BAND_MM), last.depth_mm + BAND_MM
        mask = ((depth_mm >= low) & (depth_mm <= high)).astype(np.uint8)
        mask = np.asarray(cv2.morphologyEx(mask, cv2.MORPH_OPEN, _KERNEL), dtype=np.uint8)
        contours, _ = cv2.findContours(mask, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_SIMPLE)
        if not contours:
            return None
        nearest = max(contours, key=lambda contour: cv2.pointPolygonTest(contour, last.pixel, True))
        centre = np.asarray(nearest, dtype=np.float64).reshape(-1, 2).mean(axis=0)
        filled = np.zeros_like(mask)
        cv2.drawContours(filled, [nearest], -1, 1, cv2.FILLED)
        rows, columns = np.nonzero((filled > 0) & (mask > 0))
        if not len(rows):
            return None
        chosen = int(np.argmin((columns - centre[0]) ** 2 + (rows - centre[1]) ** 2))
        pixel = (float(columns[chosen]), float(rows[chosen]))
        depth = float(depth_mm[rows[chosen], columns[chosen]])
        self._last[side] = _Last(pixel, depth)
        return ThesisFoot(_deproject(pixel, depth, camera), "depth", None)


def _deproject(pixel: tuple[float, float], depth_mm: float, camera: CameraModel) -> FloatArray:
    x, y = camera.undistort(np.array([pixel]))[0]
    z = 1e-3 * depth_mm
    return np.array([x * z, y * z, z])
