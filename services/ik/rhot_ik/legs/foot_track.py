"""One foot as its leg needs it: the ankle, level when the sole is, carried on while the foot is not seen.

How a marker is tilted on its instep is learnt from stands. A foot of which little is known swings as a damped pendulum
about the place where it usually is, as seen from the hips: with that place r, the hips' velocity v and the ankle x,

    x'' = ω²·(r − x) − 2·ζ·ω·(x' − v).

ω = 5 /s and ζ = 0.6 were chosen on simulated walks: a moving foot that is lost is then 70 mm off after 0.2 s and about
100 mm from 0.3 s on, where one that keeps its velocity is 91 mm and 541 mm off after 0.2 and 0.8 s. What was
measured and the pendulum are mixed by how much the foot's `sigma` and age leave to trust; trust is lost at once and
comes back over a tenth of a second or more, so that a foot that is found again does not jump.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from rhot.geometry.rotations import (
    orthonormal,
    rotation_between,
    rotation_from_quaternion,
    rotation_from_vector,
    shortest_rotation,
)
from rhot.geometry.transforms import rigid
from rhot.messages import FootPose, State
from rhot_ik.legs.ankle import Ankle

FloatArray = NDArray[np.float64]

LEAD_S: Final = 0.06
"""A foot is carried on by its velocity for so long."""
_LEARNING: Final = 0.03
_LEAST_LEVEL: Final = 0.77
"""Cosine of the steepest instep, 40°."""
_RATE: Final = 5.0
_DAMPING: Final = 0.6
_SWING_M: Final = 0.1
"""How far off the pendulum is."""
_SURE_M: Final = 0.03
"""A foot whose place is known as well as this is trusted entirely."""
_STRAYS_M_S: Final = 1.5
"""How much worse a foot is known per second in which it is not heard of."""
_REGAIN_S: Final = 0.1
_CATCH_UP_M: Final = 0.01
_CATCH_UP_M_S: Final = 6.0
"""Trust in a foot that is found again comes back over so long, and not so fast that the foot rushes there faster."""
_LEAP_RAD: Final = 0.35
_LEAP_RAD_S: Final = 15.0
"""By how much a foot may turn from one sample to the next, and how much more per second between them."""
_SURE: Final = 0.9
_TRUSTED: Final = 0.5
_GUESSED_NS: Final = 200_000_000
"""A foot that was only guessed for so long is not known: on simulated walks its knee is 170 mm off from then on."""
_LEVELLING_S: Final = 0.3
_TURNING_S: Final = 0.04
"""Over so long is the rate of a foot's turning averaged."""
_USUAL_S: Final = 2.0
_LONGEST_STEP_S: Final = 0.1


class FootLevel:
    """How a foot's marker sits on its instep: learnt from stands, where the sole is level.

    Attributes:
        R_foot_level: (3, 3) from the axes of the ankle, level when the foot stands flat, to those of `FootPose`.
    """

    def __init__(self) -> None:
        self._up = np.array([0.0, 1.0, 0.0])
        self.R_foot_level: FloatArray = np.eye(3)

    def learn(self, R_rig_foot: FloatArray, up: FloatArray) -> None:
        """Take one sample of a foot that stands still; one tipped by more than an instep is no stand."""
        seen = R_rig_foot.T @ up
        if seen[1] < _LEAST_LEVEL:
            return
        self._up = self._up + _LEARNING * (seen - self._up)
        self.R_foot_level = shortest_rotation(np.array([0.0, 1.0, 0.0]), self._up / np.linalg.norm(self._up))


@dataclass(frozen=True, slots=True)
class Carrier:
    """The hips from which a foot hangs, as of the last solution.

    Attributes:
        T_rig_hips: (4, 4).
        velocity: (3,) m/s, rig frame.
    """

    T_rig_hips: FloatArray
    velocity: FloatArray


@dataclass(frozen=True, slots=True)
class _Sample:
    t_ns: int
    place: FloatArray
    velocity: FloatArray
    R: FloatArray
    rate: FloatArray
    sigma_m: float
    state: State
    stands: bool


class FootTrack:
    """Follows one foot.

    Args:
        ankle_m: (3,) place of the ankle in the frame of `FootPose`.
        usual_m: (3,) where the ankle usually is in the frame of the hips, as long as nothing else is learnt.
        up: (3,) unit vector against gravity, rig frame.
    """

    def __init__(self, ankle_m: FloatArray, usual_m: FloatArray, up: FloatArray) -> None:
        self._ankle_m = ankle_m
        self._usual_m = usual_m.copy()
        self._up = up
        self._level = FootLevel()
        self._floor_m = -math.inf
        self._sample: _Sample | None = None
        self._last: Ankle | None = None
        self._trusted_ns: int | None = None
        self._velocity = np.zeros(3)
        self._t_ns = 0

    def feed(self, foot: FootPose) -> None:
        """Take a pose of the foot."""
        R_rig_foot = rotation_from_quaternion(np.array(foot.orientation))
        place = R_rig_foot @ self._ankle_m + np.array(foot.position)
        stands = foot.stationary and foot.state == "measured"
        if stands:
            self._level.learn(R_rig_foot, self._up)
            self._floor_m = float(place @ self._up)
        R = R_rig_foot @ self._level.R_foot_level
        rate = np.zeros(3) if self._sample is None else _rate(self._sample, foot.t_ns, R)
        # The ankle of a foot that lifts its heel moves while its marker hardly does.
        velocity = np.array(foot.velocity) + np.cross(rate, R_rig_foot @ self._ankle_m)
        sample = _Sample(foot.t_ns, place, velocity, R, rate, foot.sigma, foot.state, stands)
        if self._last is not None and self._sample is not None and _leaps(self._sample, sample):
            self._last = Ankle(self._last.T_rig_ankle, 0.0)
        self._sample = sample

    @property
    def state(self) -> State | None:
        """Whether the ankle that was last asked for is measured or predicted; None when it is not known."""
        if self._sample is None or self._trusted_ns is None or self._t_ns - self._trusted_ns > _GUESSED_NS:
            return None
        return self._sample.state if self._trusted_ns == self._t_ns else "predicted"

    @property
    def stands(self) -> bool:
        """The foot was just seen to stand still."""
        return self._sample is not None and self._sample.stands and self._last is not None and self._last.trust > _SURE

    def at(self, t_ns: int, carrier: Carrier | None, higher_m: float = 0.0) -> Ankle | None:
        """Return the ankle at a moment, later than any asked for before; None when the foot was never heard of.

        Args:
            t_ns: when.
            carrier: the hips, if they are known.
            higher_m: how much higher the ankle is in the foot than configured.
        """
        if self._sample is None:
            return None
        sample, age_s = self._sample, 1e-9 * (t_ns - self._sample.t_ns)
        seen = sample.place + min(age_s, LEAD_S) * sample.velocity + higher_m * sample.R[:, 1]
        doubt_m = max(sample.sigma_m - _SURE_M, 0.0) + _STRAYS_M_S * max(age_s, 0.0)
        trust = 1.0 / (1.0 + (doubt_m / _SWING_M) ** 4)
        if self._last is None or carrier is None:
            ankle, velocity = Ankle(rigid(sample.R, seen), trust), sample.velocity
        else:
            elapsed_s = min(max(1e-9 * (t_ns - self._t_ns), 0.0), _LONGEST_STEP_S)
            place, velocity = self._swing(self._last.place, carrier, elapsed_s)
            catch_up_m = _CATCH_UP_M + _CATCH_UP_M_S * elapsed_s
            reached = catch_up_m / max(float(np.linalg.norm(seen - place)), catch_up_m)
            trust = min(trust, self._last.trust + elapsed_s / _REGAIN_S, reached)
            R = self._turned(self._last.T_rig_ankle[:3, :3], carrier.T_rig_hips[:3, :3], elapsed_s)
            R = orthonormal(rotation_from_vector(trust * rotation_between(R, sample.R)) @ R)
            ankle = Ankle(rigid(R, place + trust * (seen - place)), trust)
            velocity = velocity + trust * (sample.velocity - velocity)
            self._learn_usual(ankle, carrier, elapsed_s)
        self._last, self._velocity, self._t_ns = ankle, velocity, t_ns
        if ankle.trust >= _TRUSTED:
            self._trusted_ns = t_ns
        return ankle

    def _swing(self, place: FloatArray, carrier: Carrier, elapsed_s: float) -> tuple[FloatArray, FloatArray]:
        """Return place and velocity (3,) of the pendulum a little later; it does not swing through the floor."""
        usual = carrier.T_rig_hips[:3, :3] @ self._usual_m + carrier.T_rig_hips[:3, 3]
        pull = _RATE**2 * (usual - place) - 2.0 * _DAMPING * _RATE * (self._velocity - carrier.velocity)
        velocity = self._velocity + elapsed_s * pull
        place = place + elapsed_s * velocity
        under_m = self._floor_m - float(place @ self._up)
        if under_m > 0.0:
            place = place + under_m * self._up
            velocity = velocity - min(float(velocity @ self._up), 0.0) * self._up
        return place, velocity

    def _turned(self, R: FloatArray, R_rig_hips: FloatArray, elapsed_s: float) -> FloatArray:
        """Return a foot's axes a little later: a foot that nobody sees becomes level and straight ahead."""
        share = -math.expm1(-elapsed_s / _LEVELLING_S)
        return rotation_from_vector(share * rotation_between(R, R_rig_hips)) @ R

    def _learn_usual(self, ankle: Ankle, carrier: Carrier, elapsed_s: float) -> None:
        if ankle.trust < _SURE:
            return
        hips = carrier.T_rig_hips
        place = hips[:3, :3].T @ (ankle.T_rig_ankle[:3, 3] - hips[:3, 3])
        self._usual_m += -math.expm1(-elapsed_s / _USUAL_S) * (place - self._usual_m)


def _rate(before: _Sample, t_ns: int, R: FloatArray) -> FloatArray:
    """Return how fast a foot turns (3,), rad/s, rig frame."""
    elapsed_s = 1e-9 * (t_ns - before.t_ns)
    if not 0.0 < elapsed_s < LEAD_S:
        return np.zeros(3)
    turned = rotation_between(before.R, R) / elapsed_s
    rate: FloatArray = before.rate - math.expm1(-elapsed_s / _TURNING_S) * (turned - before.rate)
    return rate


def _leaps(before: _Sample, after: _Sample) -> bool:
    """Tell whether a foot is suddenly turned some other way."""
    elapsed_s = max(1e-9 * (after.t_ns - before.t_ns), 0.0)
    return float(np.linalg.norm(rotation_between(before.R, after.R))) > _LEAP_RAD + _LEAP_RAD_S * elapsed_s
