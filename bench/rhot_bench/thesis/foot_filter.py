"""The filter of "Foot Tracking in VR" (2021), for comparison: behind the same calls as `FootFilter`.

A Kalman filter over position, velocity and acceleration with three kinds of measurement (marker, depth blob, inertial
acceleration), prediction at the time of reading, and exponential smoothing of what is read, s ← s + α·(x − s) with
α = 0.2. An acceleration below 0.5 m/s² counts as standing still. It has no gate, takes measurements in the order in
which they arrive as if they were of that moment, and knows no biases.

The thesis's noise values are not in `design.md`; those below are our reading: what its own stages were measured to err
by (3 mm standing, 41 mm with the marker covered), and a process noise with which the filter follows a step. The
direction of the sensor's north, which was set by hand, is taken from the first orientation of the marker together with
that of the sensor, which assumes that it is strapped on straight: x right, y up and z backwards like the foot's frame.
"""

from __future__ import annotations

import math
from typing import Final

import numpy as np
from numpy.typing import NDArray

from rhot.geometry.rotations import quaternion_from_rotation, rotation_from_quaternion, rotation_z
from rhot_feet.filter.model import FootFilterSettings, FootState, Stage
from rhot_feet.imu.conversion import up_rotation
from rhot_feet.imu.samples import GRAVITY_M_S2, ImuSamples

FloatArray = NDArray[np.float64]

ALPHA: Final = 0.2
STANDING: Final = 0.5
"""m/s²"""
MARKER_NOISE_M: Final = 0.003
DEPTH_NOISE_M: Final = 0.041
ACCELERATION_NOISE: Final = 0.5
"""m/s²"""
JERK_NOISE: Final = 50.0
"""m/s³/√Hz: white jerk that drives the process."""
_UNIT: Final = np.eye(3)


class ThesisFilter:
    """Filters one foot as the thesis did; the calls are those of `FootFilter`."""

    def __init__(self, settings: FootFilterSettings | None = None) -> None:
        self.settings = settings or FootFilterSettings()
        self._C = up_rotation(np.array(self.settings.up))
        self._t_ns: int | None = None
        self._x = np.zeros((3, 3))
        self._P = np.diag([1.0, 1.0, 1.0])
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
            if self._yaw_rad is None or self._t_ns is None:
                continue
            acceleration = np.zeros(3) if self._standing else self._C @ rotation_z(self._yaw_rad) @ level
            self._predict(t_ns)
            self._correct(2, acceleration, ACCELERATION_NOISE)
            if self._standing:
                self._correct(1, np.zeros(3), ACCELERATION_NOISE)

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
        return self._update_position(t_ns, position, MARKER_NOISE_M, "marker")

    def update_depth(self, t_ns: int, position: FloatArray, covariance: FloatArray) -> bool:
        """Update with a position (3,) of the foot's origin from the depth image; it is always accepted."""
        return self._update_position(t_ns, position, DEPTH_NOISE_M, "depth")

    def state(self, t_ns: int) -> FootState | None:
        """Return the foot at a moment, smoothed over the readings; None before it was first seen."""
        if self._t_ns is None:
            return None
        h = max(t_ns - self._t_ns, 0) * 1e-9
        F = _transition(h)
        x = F @ self._x
        self._smooth = x[0] if self._smooth is None else self._smooth + ALPHA * (x[0] - self._smooth)
        variance = float((F @ self._P @ F.T + _growth(h))[0, 0])
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

    def _update_position(self, t_ns: int, position: FloatArray, noise_m: float, stage: Stage) -> bool:
        if self._t_ns is None:
            self._t_ns = t_ns
            self._x[0] = position
        self._predict(t_ns)
        self._correct(0, position, noise_m)
        self._seen[stage] = t_ns
        return True

    def _predict(self, t_ns: int) -> None:
        if self._t_ns is None or t_ns <= self._t_ns:
            return
        h = (t_ns - self._t_ns) * 1e-9
        F = _transition(h)
        self._x, self._P, self._t_ns = F @ self._x, F @ self._P @ F.T + _growth(h), t_ns

    def _correct(self, order: int, value: FloatArray, noise: float) -> None:
        """Correct the derivative of the position of this order; all axes are alike, so one (3, 3) covariance serves."""
        gain = self._P[:, order] / (self._P[order, order] + noise**2)
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


def _growth(h: float) -> FloatArray:
    rows = [[h**5 / 20.0, h**4 / 8.0, h**3 / 6.0], [h**4 / 8.0, h**3 / 3.0, h**2 / 2.0], [h**3 / 6.0, h**2 / 2.0, h]]
    return JERK_NOISE**2 * np.array(rows)
