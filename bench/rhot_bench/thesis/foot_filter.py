"""The filter of "Foot Tracking in VR" (2021), for comparison: behind the same calls as `FootFilter`.

A Kalman filter over position, velocity and acceleration with three kinds of measurement (marker, depth blob, inertial
acceleration), prediction at the time of reading, and exponential smoothing of what is read, s ← s + α·(x − s). Its
noise values, initial covariance and α are the thesis's own. An acceleration below 0.5 m/s² counts as standing still:
velocity and acceleration become zero and the position is kept. It has no gate, takes measurements in the order in
which they arrive as if they were of that moment, and knows no biases.

Ours: Q is added once per measurement, whatever the time between two of them, because the thesis prints it without a
time step; reading does not change the filter; and the direction of the sensor's north, which was set by hand, is taken
from the first orientation of the marker together with that of the sensor, which assumes that it is strapped on
straight: x right, y up and z backwards like the foot's frame.
"""

from __future__ import annotations

import math
from typing import Final

import numpy as np

from rhot.arrays import FloatArray
from rhot.geometry.rotations import quaternion_from_rotation, rotation_from_quaternion, rotation_z
from rhot_feet.filter.model import FootFilterSettings, FootState, Stage
from rhot_feet.imu.conversion import up_rotation
from rhot_feet.imu.samples import GRAVITY_M_S2, ImuSamples

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
