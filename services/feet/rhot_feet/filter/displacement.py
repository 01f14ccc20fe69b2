"""How far a foot has gone unseen, by a sensor whose heading is not known yet.

Before a sensor is aligned, nobody knows in which direction of the room it is carried, but it measures how far: with the
specific force f and its rotation R to its own level world,

    v' = R f + g,   d' = v,   d = v = 0 when it last stood in sight.

So a foot that stays where it was seen is wrong by |d|, and by what the sensor's place on the foot adds when the foot
rotates. That is far less than what a foot could do of which nothing is known.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Final

import numpy as np
from numpy.typing import NDArray

from rhot.geometry.rotations import rotation_cosine
from rhot_feet.filter.model import FootMotion
from rhot_feet.imu.samples import GRAVITY_M_S2
from rhot_feet.imu.track import DROPOUT, ImuInterval

FloatArray = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class DisplacementSettings:
    """How wrong the displacement is.

    Attributes:
        acceleration_m_s2: error of the level acceleration, one sigma: a tilt of 1.5° (`InertialSettings.tilt_rad`).
        position_m: of the foot when it stood, one sigma over all axes.
    """

    acceleration_m_s2: float = GRAVITY_M_S2 * math.sin(math.radians(1.5))
    position_m: float = 0.01


SETTINGS: Final = DisplacementSettings()
_GRAVITY: Final = np.array([0.0, 0.0, GRAVITY_M_S2])


class UnseenDisplacement:
    """Integrates one sensor since its foot was last seen standing.

    Args:
        sensor_m: (3,) about where the sensor is worn, metres, foot frame.
    """

    def __init__(self, sensor_m: FloatArray) -> None:
        self._lever_m = float(np.linalg.norm(sensor_m))
        self._known, self._t_ns = False, 0
        self._R_start: FloatArray = np.eye(3)
        self._R: FloatArray = np.eye(3)
        self._velocity, self._way = np.zeros(3), np.zeros(3)
        self._moving_s = self._drift_m = 0.0

    def forget(self) -> None:
        """Note that samples are missing, or that the foot moves in sight: its velocity is not known."""
        self._known = False

    def add(self, interval: ImuInterval, *, seen: bool) -> None:
        """Add what was measured since the sample before; `seen`: a standing foot still stands where it was seen."""
        h, still = interval.step.duration_s, interval.zero_velocity.still
        self._R, self._t_ns = interval.R_world, interval.t_ns
        if seen and still:
            self._known, self._R_start = True, self._R
            self._velocity, self._way = np.zeros(3), np.zeros(3)
            self._moving_s = self._drift_m = 0.0
        elif still:
            # The velocity that it had gathered was wrong: half of it on average.
            self._drift_m += 0.5 * float(np.linalg.norm(self._velocity)) * self._moving_s
            self._velocity, self._moving_s = np.zeros(3), 0.0
        else:
            acceleration = interval.R_world @ interval.step.force_after - _GRAVITY
            self._way = self._way + h * self._velocity + (0.5 * h * h) * acceleration
            self._velocity = self._velocity + h * acceleration
            self._moving_s += h

    def known_at(self, t_ns: int) -> bool:
        """Return whether a sensor has followed the foot from a stand in sight until a moment."""
        return self._known and t_ns - self._t_ns <= DROPOUT.held_ns

    @property
    def bound_m(self) -> float:
        """Distance from where the foot was seen, one sigma, metres."""
        chord = math.sqrt(max(0.0, 2.0 - 2.0 * rotation_cosine(self._R, self._R_start)))
        drift_m = self._drift_m + 0.5 * SETTINGS.acceleration_m_s2 * self._moving_s**2
        return math.hypot(float(np.linalg.norm(self._way)), self._lever_m * chord, drift_m, SETTINGS.position_m)

    def bounded(self, t_ns: int, motion: FootMotion) -> FootMotion:
        """Return the motion at a moment of a foot that stays where it was seen: it is no farther off than it went."""
        if not self.known_at(t_ns) or self.bound_m**2 >= float(np.trace(motion.covariance)):
            return motion
        return replace(motion, covariance=self.bound_m**2 / 3.0 * np.eye(3))
