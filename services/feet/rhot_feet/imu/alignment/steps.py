"""Steps of a foot from one stand-still to the next, as its sensor felt them and as pictures show their ends.

A walking foot is mostly out of sight or blurred while it swings, but it is seen before and after. A sensor that felt
it stand at both ends knows the step in its own level axes: with f' = R_world_sensor·f + g, V = ∫f' and D = ∬f' over the
T seconds in between,

    d = D − ½·T·V,

because the velocity is zero at the end, so that V is the work of an even error of acceleration (tilt and bias), which
has moved D by half of T·V. One step tells the yaw between the sensor's and the rig's axes to a few degrees.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from rhot_feet.imu.zero_velocity import GRAVITY

FloatArray = NDArray[np.float64]

_LONGEST_S: Final = 1.5
"""After so long between two stand-stills the sensor alone does not know the way any more."""
_GAP_S: Final = 0.035
"""Samples farther apart have others missing between them; the foot swings on meanwhile."""
_SIGHTINGS: Final = 3
"""So often has the marker to be seen on each side of a step."""
_KEPT: Final = 12
_GRAVITY: Final = np.array([0.0, 0.0, GRAVITY])


@dataclass(frozen=True, slots=True)
class Step:
    """A foot's way between two places where it stood and was seen, through any number of stand-stills unseen.

    Attributes:
        seen: (3,) how far the marker moved, metres, axes of the sightings.
        felt: (3,) how far the sensor moved, metres, its own level axes.
        by_bias: (3, 3) derivative of −`felt` by the accelerometer's bias, s².
        turned: (3, 3) difference of the sensor's orientations, R_world_sensor after minus before.
    """

    seen: FloatArray
    felt: FloatArray
    by_bias: FloatArray
    turned: FloatArray


@dataclass(slots=True)
class _Stand:
    """A stand-still: when, how the sensor was turned, how it got here, and where the marker was seen."""

    start_ns: int
    end_ns: int
    R: FloatArray
    felt: FloatArray
    by_bias: FloatArray
    whole: bool
    total: FloatArray
    count: int = 0
    used: bool = False

    @property
    def place(self) -> FloatArray:
        mean: FloatArray = self.total / self.count
        return mean


class StepWatcher:
    """Follows one sensor from stand-still to stand-still."""

    def __init__(self) -> None:
        self._stands: deque[_Stand] = deque(maxlen=_KEPT)
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

    def imu(self, t_ns: int, specific_force: FloatArray, R: FloatArray, *, stands: bool) -> None:
        """Take the next sample.

        Args:
            t_ns: of the sample.
            specific_force: (3,) m/s², sensor frame.
            R: (3, 3) R_world_sensor.
            stands: the foot was felt to stand.
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
            self._whole &= h <= _GAP_S
        if stands:
            way = self._way - (0.5 * self._duration_s) * self._speed
            whole = self._whole and 0.0 < self._duration_s <= _LONGEST_S
            self._stands.append(_Stand(t_ns, t_ns, R, way[:, 0], way[:, 1:], whole, np.zeros(3)))
            self._set_off()

    def marker(self, t_ns: int, position: FloatArray) -> Step | None:
        """Take a believed place (3,) of the marker; return the step that it completes."""
        index = next((k for k, stand in enumerate(self._stands) if stand.start_ns <= t_ns <= stand.end_ns), None)
        if index is None:
            return None
        stand = self._stands[index]
        stand.total, stand.count = stand.total + position, stand.count + 1
        if stand.used or stand.count < _SIGHTINGS:
            return None
        felt, by_bias = np.zeros(3), np.zeros((3, 3))
        for k in range(index, 0, -1):
            if not self._stands[k].whole:
                return None
            felt, by_bias = felt + self._stands[k].felt, by_bias + self._stands[k].by_bias
            start = self._stands[k - 1]
            if start.count >= _SIGHTINGS:
                stand.used = True
                return Step(stand.place - start.place, felt, by_bias, stand.R - start.R)
        return None
