"""How far a foot has gone unseen, by a sensor that is not aligned yet.

Before a sensor is aligned, nobody has measured in which direction of the room it is carried, but it measures how far:
with the specific force f and its rotation R to its own level world,

    v' = R f + g,   d' = v,   d = v = 0 when it last stood in sight.

With ψ, the yaw from the sensor's level world to the rig's, and s, where on the foot it is worn, the marker has moved by

    Rz(ψ) d − (R_foot − R_foot,0) s,   R_foot = Rz(ψ) R R₀ᵀ Rz(−ψ) R_foot,0.

What of this does not depend on the yaw is known at once: how high the foot was lifted. The yaw follows from how a heel
is lifted: the foot turns on its ball, toes downwards, about an axis across it, and where that lies was seen while the
foot stood. Toes that are lifted turn the foot the other way round; but then the ankle, which lies close before the
heel, hardly rises. Until a heel was lifted, a foot that stays where it was seen is wrong by the level part of d.
"""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass, replace
from typing import Final

import numpy as np

from rhot.arrays import FloatArray
from rhot.geometry.rotations import cross_matrix, rotation_cosine, rotation_z, vector_from_rotation
from rhot_feet.filter.model import FootMotion
from rhot_feet.imu.samples import GRAVITY_M_S2
from rhot_feet.imu.track import HELD_NS, ImuInterval

_EARLY_RAD: Final = 0.1
"""By how much the axis of a hardly lifted heel differs from straight across the foot, by the sine of the lift: the
joints of the toes lie askew. With the 0.17 of any lift, this is 20° at a lift of 20° and 12° at 55°. Five recorded
walks were 20° off there, root mean square, and 11° at their highest lifts of 31 to 66° (`rhot evaluate steps`)."""


_UNIT: Final = np.eye(3)
_GRAVITY: Final = np.array([0.0, 0.0, GRAVITY_M_S2])


@dataclass(frozen=True, slots=True)
class _Lift:
    """The heel as high as it was lifted since the foot stood.

    Attributes:
        lift_rad: how far.
        direction_rad: of the axis about which the toes went down, in the level plane of the sensor's world.
    """

    lift_rad: float
    direction_rad: float

    @property
    def sigma_rad(self) -> float:
        """Of the yaw that follows from it."""
        # By how much the axis of a lifted heel differs from straight across the foot, however high it is.
        return math.hypot(0.17, _EARLY_RAD / math.sin(self.lift_rad))


@dataclass(frozen=True, slots=True)
class _Moment:
    """What the sensor had measured by a moment since the foot stood.

    Attributes:
        t_ns: the moment.
        way: (3,) of the sensor, metres, its own level world.
        R: (3, 3) from the sensor to that world.
        moving_s: since it last stood, in sight or not.
        drift_m: error of the way by what was before that, over all axes.
    """

    t_ns: int
    way: FloatArray
    R: FloatArray
    moving_s: float = 0.0
    drift_m: float = 0.0


@dataclass(frozen=True, slots=True)
class _Sight:
    """Where the foot was last seen.

    Attributes:
        position: (3,) metres, rig frame.
        covariance: (3, 3) m².
        moment: what the sensor had measured by then.
    """

    position: FloatArray
    covariance: FloatArray
    moment: _Moment


class UnseenDisplacement:
    """Integrates one sensor since its foot was last seen standing.

    Args:
        C: (3, 3) from level axes (z up) to the rig frame.
        sensor_m: (3,) about where the sensor is worn, metres, foot frame.
    """

    def __init__(self, C: FloatArray, sensor_m: FloatArray) -> None:
        self._C, self._sensor_m = C, sensor_m
        self._known = False
        self._start = self._now = _Moment(0, np.zeros(3), np.eye(3))
        self._velocity = np.zeros(3)
        self._standing: deque[ImuInterval] = deque()
        self._before: deque[_Moment] = deque()
        self._lift: _Lift | None = None
        self._toes_first = False
        self._stood: FootMotion | None = None
        self._seen: _Sight | None = None

    @property
    def sets_off(self) -> bool:
        """Whether the foot, which stood in sight, has just begun to move: `stood` wants to know where that was."""
        return self._known and self._stood is None and self._now.moving_s > 0.0

    def stood(self, motion: FootMotion) -> None:
        """Note where the foot stood when it set off."""
        self._stood = motion
        # Standard deviation of the foot's position when it stood.
        self._seen = _Sight(motion.position, 0.01**2 / 3.0 * _UNIT, self._start)

    def forget(self) -> None:
        """Note that samples are missing."""
        self._known = False

    def see(self, t_ns: int, motion: FootMotion) -> None:
        """Note where a moving foot was at a moment at which it was seen."""
        moment = self._moment(t_ns)
        if moment is None or not self._known or self._stood is None:
            self._known = False
        else:
            sight = _Sight(motion.position, motion.covariance, moment)
            now, before = (self._since(seen, self._now, motion) for seen in (sight, self._seen))
            if before is None or (now is not None and np.trace(now.covariance) < np.trace(before.covariance)):
                self._seen = sight

    def add(self, interval: ImuInterval, *, seen: bool) -> None:
        """Add what was measured since the sample before; `seen`: a standing foot still stands where it was seen."""
        now, still = self._now, interval.zero_velocity.still
        if seen and still:
            self._known, self._toes_first = True, False
            self._lift = self._stood = self._seen = None
            self._start = now = _Moment(interval.t_ns, np.zeros(3), interval.R_world)
            self._velocity = np.zeros(3)
        elif interval.step.dropout:
            # One sample tells nothing of a tenth of a second: taken for all of it a foot that sets off gains 2 m/s.
            self.forget()
        elif still:
            # The velocity that it had gathered was wrong. An even error a, v = a·t, led it astray by a·t²/2.
            even = self._velocity / max(now.moving_s, 1e-3)
            astray = (0.5 * now.moving_s**2) * even
            if self._seen is not None and now.moving_s > 0.0:
                then = self._seen.moment
                corrected = replace(then, way=then.way - (0.5 * then.moving_s**2) * even, moving_s=0.0)
                self._seen = replace(self._seen, moment=corrected)
            # Share of a swing's correction by its end that is still wrong: tilt and bias are not quite
            # even.
            drift_m = now.drift_m + 0.3 * float(np.linalg.norm(astray))
            now = _Moment(interval.t_ns, now.way - astray, interval.R_world, 0.0, drift_m)
            self._velocity = np.zeros(3)
        else:
            # What was still called standing was the beginning of it.
            for before in self._standing:
                now = self._moved(now, before)
            self._standing.clear()
            now = self._moved(now, interval)
        if still:
            self._standing.append(interval)
            # How late it is noticed that a foot sets off: the window of the zero-velocity detector.
            while interval.t_ns - self._standing[0].t_ns > 40_000_000:
                self._standing.popleft()
        self._now = now
        self._before.append(now)
        # How late what is seen may be.
        while now.t_ns - self._before[0].t_ns > 250_000_000:
            self._before.popleft()
        if now.moving_s > 0.0:
            self._note_lift()

    def _moved(self, now: _Moment, interval: ImuInterval) -> _Moment:
        """Return the moment after an interval in motion."""
        h = interval.step.duration_s
        acceleration = interval.R_world @ interval.step.force_after - _GRAVITY
        way = now.way + h * self._velocity + (0.5 * h * h) * acceleration
        self._velocity = self._velocity + h * acceleration
        return _Moment(interval.t_ns, way, interval.R_world, now.moving_s + h, now.drift_m)

    def known_at(self, t_ns: int) -> bool:
        """Return whether a sensor has followed the foot from a stand in sight until a moment."""
        return self._known and t_ns - self._now.t_ns <= HELD_NS

    def moved(self, t_ns: int, motion: FootMotion) -> FootMotion:
        """Return the foot at a moment; `motion`, what is known otherwise, where the sensor knows no better."""
        moment = self._moment(t_ns) if self.known_at(t_ns) else None
        moved = None if moment is None else self._since(self._seen, moment, motion)
        return motion if moved is None or np.trace(moved.covariance) > np.trace(motion.covariance) else moved

    def _moment(self, t_ns: int) -> _Moment | None:
        return next((moment for moment in reversed(self._before) if moment.t_ns <= t_ns), None)

    def _since(self, seen: _Sight | None, moment: _Moment, motion: FootMotion) -> FootMotion | None:
        """Return where the foot is by where it was seen and its way since; None where that is not known."""
        stood = self._stood
        if stood is None or seen is None or moment.t_ns < seen.moment.t_ns:
            return None
        # The foot's orientation while it stood makes the sensor's way one of the marker.
        # An orientation known worse than this, per axis, was never seen.
        oriented = float(np.trace(stood.rotation_covariance)) < 3.0 * math.radians(60.0) ** 2
        if oriented and self._lift is not None:
            return self._along(motion, stood.rotation, seen, moment, self._lift)
        return self._upwards(motion, seen, moment)

    def _note_lift(self) -> None:
        """Take the lift of the heel, where it is higher than before; of toes that are lifted first nothing is taken."""
        turned = vector_from_rotation(self._now.R @ self._start.R.T)
        lift_rad = math.hypot(turned[0], turned[1])
        # A foot that is tilted by less says nothing; so far it is decided whether heel or toes rise.
        if self._toes_first or not math.radians(15.0) < lift_rad < math.radians(90.0):
            return
        if self._lift is None:
            # The point about which a foot turns lies this far before an ankle of this
            # height, or farther, when the heel is lifted: the ball is 0.1 m and more before it, the heel
            # 0.05 m behind it.
            least_m = 0.065 * math.sin(lift_rad) - 0.1 * (1.0 - math.cos(lift_rad))
            self._toes_first = self._now.way[2] < least_m
        direction_rad = math.atan2(turned[1], turned[0])
        if self._lift is None:
            lifted = not self._toes_first
        else:
            # Toes that are raised before the heel strikes turn it the other way round.
            same = math.cos(direction_rad - self._lift.direction_rad) > 0.0
            lifted = same and lift_rad > self._lift.lift_rad
        if lifted:
            self._lift = _Lift(lift_rad, direction_rad)

    def _error_m(self, then: _Moment, now: _Moment, lever_m: float) -> float:
        """Return the error of the way between two moments, over all axes, with a lever that is known so well."""
        chord = math.sqrt(max(0.0, 2.0 - 2.0 * rotation_cosine(now.R, then.R)))
        drift_m = (
            # Error of the level acceleration: a tilt of 1.5°.
            0.5
            * (GRAVITY_M_S2 * math.sin(math.radians(1.5)))
            * (now.moving_s**2 - then.moving_s**2 * (now.drift_m == then.drift_m))
        )
        return math.hypot(lever_m * chord, now.drift_m - then.drift_m + drift_m)

    def _upwards(self, motion: FootMotion, seen: _Sight, now: _Moment) -> FootMotion:
        """Return the foot lifted, but where to is not known."""
        up = self._C[:, 2]
        way = now.way - seen.moment.way
        error_m = self._error_m(seen.moment, now, float(np.linalg.norm(self._sensor_m)))
        level = (float(way[:2] @ way[:2]) / 2.0) * (_UNIT - np.outer(up, up))
        covariance = seen.covariance + level + (error_m**2 / 3.0) * _UNIT
        return replace(motion, position=seen.position + way[2] * up, covariance=covariance)

    def _along(self, motion: FootMotion, R_stood: FloatArray, seen: _Sight, now: _Moment, lift: _Lift) -> FootMotion:
        """Return the foot where it went, by the direction that its lifted heel told."""
        C, up = self._C, self._C[:, 2]
        toes_down = -(C.T @ R_stood[:, 0])
        Z = C @ rotation_z(math.atan2(toes_down[1], toes_down[0]) - lift.direction_rad)
        arm, way = R_stood @ self._sensor_m, Z @ (now.way - seen.moment.way)
        turns = [Z @ moment.R @ self._start.R.T @ Z.T for moment in (now, seen.moment)]
        turned = turns[0] - turns[1]
        # Derivatives by the yaw: of the marker's way, and of the rotation, as a vector.
        about_up = cross_matrix(up)
        d_position = about_up @ way - (about_up @ turned - turned @ about_up) @ arm
        d_rotation = up - turns[0] @ up
        # Where on the foot the sensor is: a strap goes 3 cm around the ankle.
        yaw_variance, error_m = lift.sigma_rad**2, self._error_m(seen.moment, now, 0.03)
        return replace(
            motion,
            position=seen.position + way - turned @ arm,
            rotation=turns[0] @ R_stood,
            covariance=seen.covariance + yaw_variance * np.outer(d_position, d_position) + (error_m**2 / 3.0) * _UNIT,
            # Standard deviation of its rotation when it stood, per axis.
            rotation_covariance=yaw_variance * np.outer(d_rotation, d_rotation) + math.radians(5.0) ** 2 * _UNIT,
        )
