"""Steps of a foot from one stand-still to the next, as its sensor measured them and as pictures show their ends.

A walking foot is mostly out of sight or blurred while it swings, but it is seen before and after. A sensor that stood
at both ends knows the step in its own level axes: with f' = R_world_sensor·f + g, V = ∫f' and D = ∬f' over the
T seconds in between,

    d = D − ½·T·V,

because the velocity is zero at the end, so that V is the work of an even error of acceleration (tilt and bias), which
has moved D by half of T·V. One step gives the yaw between the sensor's and the rig's axes to a few degrees.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass
from typing import Final

import numpy as np

from rhot.arrays import FloatArray
from rhot_feet.imu.alignment.equations import SETTINGS
from rhot_feet.imu.samples import GRAVITY_M_S2

_GRAVITY: Final = np.array([0.0, 0.0, GRAVITY_M_S2])


@dataclass(frozen=True, slots=True)
class Step:
    """A foot's way between two positions where it stood and was seen, through any number of stand-stills unseen.

    Attributes:
        marker_m: (3,) how far the marker moved, metres, axes of the sightings.
        imu_m: (3,) how far the sensor moved, metres, its own level axes.
        d_bias: (3, 3) derivative of −`imu_m` by the accelerometer's bias, s².
        rotation_change: (3, 3) difference of the sensor's orientations, R_world_sensor after minus before.
    """

    marker_m: FloatArray
    imu_m: FloatArray
    d_bias: FloatArray
    rotation_change: FloatArray


@dataclass(slots=True)
class _Stand:
    """A stand-still: when, how the sensor was oriented, how it got here, and where the marker was seen."""

    start_ns: int
    end_ns: int
    R: FloatArray
    imu_m: FloatArray
    d_bias: FloatArray
    whole: bool
    total: FloatArray
    count: int = 0
    used: bool = False

    @property
    def position(self) -> FloatArray:
        mean: FloatArray = self.total / self.count
        return mean


class StepTracker:
    """Follows one sensor from stand-still to stand-still."""

    def __init__(self) -> None:
        self._stands: deque[_Stand] = deque(maxlen=SETTINGS.kept_stands)
        self.reset()

    def reset(self) -> None:
        """Forget everything: there was a gap, or it is another sensor."""
        self._stands.clear()
        self._t_ns: int | None = None
        self._level = np.zeros((3, 4))
        self._set_off()

    def _set_off(self) -> None:
        self._speed, self._way = np.zeros((3, 4)), np.zeros((3, 4))
        self._duration_s = 0.0
        self._whole = True

    def add_sample(self, t_ns: int, specific_force: FloatArray, R: FloatArray, *, stands: bool) -> None:
        """Add the next sample.

        Args:
            t_ns: of the sample.
            specific_force: (3,) m/s², sensor frame.
            R: (3, 3) R_world_sensor.
            stands: the sensor shows zero velocity.
        """
        # Acceleration, and beside it what a bias adds to it, both in the sensor's level axes.
        level = np.concatenate([(R @ specific_force - _GRAVITY)[:, None], R], axis=1)
        before, self._t_ns = self._t_ns, t_ns
        mean, self._level = 0.5 * (self._level + level), level
        stood = bool(self._stands) and self._duration_s == 0.0
        if stood and stands:
            self._stands[-1].end_ns = t_ns
            return
        if before is not None and (stood or self._duration_s > 0.0):
            h = 1e-9 * (t_ns - before)
            self._way += h * self._speed + (0.5 * h * h) * mean
            self._speed += h * mean
            self._duration_s += h
            self._whole &= h <= SETTINGS.gap_s
        if stands:
            way = self._way - (0.5 * self._duration_s) * self._speed
            whole = self._whole and 0.0 < self._duration_s <= SETTINGS.longest_step_s
            self._stands.append(_Stand(t_ns, t_ns, R, way[:, 0], way[:, 1:], whole, np.zeros(3)))
            self._set_off()

    def add_marker(self, t_ns: int, position: FloatArray) -> Step | None:
        """Add an accepted position (3,) of the marker; return the step that it completes."""
        index = next((k for k, stand in enumerate(self._stands) if stand.start_ns <= t_ns <= stand.end_ns), None)
        if index is None:
            return None
        stand = self._stands[index]
        stand.total, stand.count = stand.total + position, stand.count + 1
        if stand.used or stand.count < SETTINGS.sightings:
            return None
        imu_m, d_bias = np.zeros(3), np.zeros((3, 3))
        for k in range(index, 0, -1):
            if not self._stands[k].whole:
                return None
            imu_m, d_bias = imu_m + self._stands[k].imu_m, d_bias + self._stands[k].d_bias
            start = self._stands[k - 1]
            if start.count >= SETTINGS.sightings:
                stand.used = True
                return Step(stand.position - start.position, imu_m, d_bias, stand.R - start.R)
        return None
