"""How the 2021 thesis saw feet: the marker's centre and the depth at it, or the nearest blob of depth.

Marker stage: OpenCV's ArUco detector as it comes, the mean of the four corners, the aligned depth at that pixel, and
the first of the two poses of the square. No gate: what is detected is believed.

Depth stage, for a marker that is not detected: the depth image within a band about the last depth, opening, contours,
the one nearest to the last pixel, and in it the valid pixel nearest to the contour's centre. The blob's position stands
for the foot's; the marker's offset from it is not known. The width of the band and the opening's kernel are ours: the
band keeps a whole foot and parts it from the floor behind it.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Final

import cv2
import numpy as np
from numpy.typing import NDArray

from rhot.arrays import FloatArray
from rhot.geometry.camera import CameraModel
from rhot.geometry.rotations import quaternion_from_rotation, rotation_from_quaternion, rotation_z
from rhot.messages import Side
from rhot_feet.filter.model import FootFilterSettings, FootState, Stage
from rhot_feet.imu.samples import GRAVITY_M_S2, ImuSamples, up_rotation

# The filter of "Foot Tracking in VR" (2021), for comparison: behind the same calls as `FootFilter`.
#
# A Kalman filter over position, velocity and acceleration with three kinds of measurement (marker, depth blob, inertial
# acceleration), prediction at the time of reading, and exponential smoothing of what is read, s ← s + α·(x − s). Its
# noise values, initial covariance and α are the thesis's own. An acceleration below 0.5 m/s² counts as standing still:
# velocity and acceleration become zero and the position is kept. It has no gate, takes measurements in the order in
# which they arrive as if they were of that moment, and knows no biases.
#
# Ours: Q is added once per measurement, whatever the time between two of them, because the thesis prints it without a
# time step; reading does not change the filter; and the direction of the sensor's north, which was set by hand, is
# taken from the first orientation of the marker together with that of the sensor, which assumes that it is strapped
# on straight: x right, y up and z backwards like the foot's frame.

ALPHA: Final = 0.2
"""Share of a new reading in the smoothed position."""
STANDING: Final = 0.5
"""m/s²"""
Q_DIAGONAL: Final = (0.0002, 0.00006, 0.02)
"""Process noise of position, velocity and acceleration as printed on the diagonal of Q (eq. 4.9)."""
R_MARKER: Final = 0.00015
R_ACCELERATION: Final = 0.35
R_DEPTH: Final = 0.35
"""Measurement noise as printed on the diagonals of R (eq. 4.10 and 4.11)."""
P0_DIAGONAL: Final = (1.0**2, 0.75**2, 15.0**2)
"""First covariance of position, velocity and acceleration."""
_Q: Final = np.diag(Q_DIAGONAL)
_UNIT: Final = np.eye(3)


class ThesisFilter:
    """Filters one foot as the thesis did; the calls are those of `FootFilter`."""

    def __init__(self, settings: FootFilterSettings | None = None) -> None:
        self.settings = settings or FootFilterSettings()
        self._C = up_rotation(np.array(self.settings.up))
        self._t_ns: int | None = None
        self._x = np.zeros((3, 3))
        self._P = np.diag(P0_DIAGONAL)
        self._smooth: FloatArray | None = None
        self._orientation = np.array([0.0, 0.0, 0.0, 1.0])
        self._yaw_rad: float | None = None
        self._R_world: FloatArray | None = None
        self._standing = False
        self._seen: dict[str, int] = {}
        self._imu_ns = 0

    def add_imu_samples(self, samples: ImuSamples) -> None:
        """Add samples of the sensor as measurements of the acceleration."""
        rotations = rotation_from_quaternion(samples.orientation_xyzw) if len(samples) else ()
        for t_ns, force, R in zip(samples.t_ns.tolist(), samples.specific_force, rotations, strict=True):
            self._R_world, self._imu_ns = R, t_ns
            level = R @ force - np.array([0.0, 0.0, GRAVITY_M_S2])
            self._standing = math.sqrt(level @ level) < STANDING
            if self._t_ns is None:
                continue
            if self._standing:
                self._x[1:] = 0.0
            self._predict(t_ns)
            if self._standing or self._yaw_rad is None:
                continue
            self._correct(2, self._C @ rotation_z(self._yaw_rad) @ level, R_ACCELERATION)

    def update_marker(
        self,
        t_ns: int,
        position: FloatArray,
        covariance: FloatArray,
        orientation_xyzw: FloatArray | None = None,
        orientation_covariance: FloatArray | None = None,
    ) -> bool:
        """Update with a position of the foot's marker; it is always accepted."""
        if orientation_xyzw is not None:
            self._orientation = orientation_xyzw
            if self._yaw_rad is None and self._R_world is not None:
                level = self._C.T @ rotation_from_quaternion(orientation_xyzw) @ self._R_world.T
                self._yaw_rad = math.atan2(level[1, 0] - level[0, 1], level[0, 0] + level[1, 1])
        return self._update_position(t_ns, position, R_MARKER, "marker")

    def update_depth(self, t_ns: int, position: FloatArray, covariance: FloatArray) -> bool:
        """Update with a position (3,) of the foot's origin from the depth image; it is always accepted."""
        return self._update_position(t_ns, position, R_DEPTH, "depth")

    def state(self, t_ns: int) -> FootState | None:
        """Return the foot at a moment, smoothed over the readings; None before it was first seen."""
        if self._t_ns is None:
            return None
        h = max(t_ns - self._t_ns, 0) * 1e-9
        F = _transition(h)
        x = F @ self._x
        self._smooth = x[0] if self._smooth is None else self._smooth + ALPHA * (x[0] - self._smooth)
        variance = float((F @ self._P @ F.T + _Q)[0, 0])
        orientation = quaternion_from_rotation(rotation_from_quaternion(self._orientation))
        return FootState(
            t_ns,
            self._smooth.copy(),
            x[1],
            orientation,
            variance * _UNIT,
            math.radians(5.0) ** 2 * _UNIT,
            self._stage(t_ns),
            self._standing,
            max(self._seen.values()),
        )

    def _update_position(self, t_ns: int, position: FloatArray, variance: float, stage: Stage) -> bool:
        if self._t_ns is None:
            self._t_ns = t_ns
            self._x[0] = position
        self._predict(t_ns)
        self._correct(0, position, variance)
        self._seen[stage] = t_ns
        return True

    def _predict(self, t_ns: int) -> None:
        if self._t_ns is None or t_ns <= self._t_ns:
            return
        h = (t_ns - self._t_ns) * 1e-9
        F = _transition(h)
        self._x, self._P, self._t_ns = F @ self._x, F @ self._P @ F.T + _Q, t_ns

    def _correct(self, order: int, value: FloatArray, variance: float) -> None:
        """Correct the derivative of the position of this order; all axes are alike, so one (3, 3) covariance serves."""
        gain = self._P[:, order] / (self._P[order, order] + variance)
        self._x = self._x + np.outer(gain, value - self._x[order])
        self._P = self._P - np.outer(gain, self._P[order])

    def _stage(self, t_ns: int) -> Stage:
        fresh = self.settings.fresh_ns
        if t_ns - self._seen.get("marker", 0) <= fresh:
            return "marker"
        if t_ns - self._seen.get("depth", 0) <= fresh:
            return "depth"
        return "inertial" if t_ns - self._imu_ns <= fresh else "lost"


def _transition(h: float) -> FloatArray:
    return np.array([[1.0, h, 0.5 * h * h], [0.0, 1.0, h], [0.0, 0.0, 1.0]])


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
