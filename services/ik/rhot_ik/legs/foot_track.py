"""One foot as its leg needs it: the ankle, level when the sole is, carried on while the foot is not seen.

How a marker is tilted on its instep is learned from stands. A foot of which little is known swings as a damped pendulum
about the position where it usually is, as seen from the hips: with that position r, the hips' velocity v and the ankle
x,

    x'' = ω²·(r − x) − 2·ζ·ω·(x' − v).

ω = 5 /s and ζ = 0.6 were chosen on simulated walks: a moving foot that is lost is then 70 mm off after 0.2 s and about
100 mm from 0.3 s on, where one that keeps its velocity is 91 mm and 541 mm off after 0.2 and 0.8 s. What was
measured and the pendulum are mixed by how much the foot's `sigma` and age leave to trust; trust is lost at once and
comes back over a tenth of a second or more, so that a foot that is found again does not jump.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Final, Protocol

import numpy as np

from rhot.arrays import FloatArray
from rhot.geometry.rotations import (
    orthonormal,
    rigid,
    rotation_between,
    rotation_from_quaternion,
    rotation_from_vector,
    shortest_rotation,
)
from rhot.types import State, Vector3
from rhot_ik.legs.hips import Ankle

_RATE: Final = 5.0
"""Ω, 1/s, and ζ of the pendulum."""
_LEARNING_TRUST: Final = 0.9
"""Least trust at which a foot updates the lengths, and counts as measured."""

LEAD_S: Final = 0.06
"""A foot is carried on by its velocity for so long."""


class SoleLevel:
    """How a foot's marker sits on its instep: learned from stands, where the sole is level.

    Attributes:
        R_foot_level: (3, 3) from the axes of the ankle, level when the foot stands flat, to those of `FootPose`.
    """

    def __init__(self) -> None:
        self._up = np.array([0.0, 1.0, 0.0])
        self.R_foot_level: FloatArray = np.eye(3)

    def update(self, R_rig_foot: FloatArray, up: FloatArray) -> None:
        """Update with a sample of a foot that stands still; one tipped by more than an instep does not stand.

        Args:
            R_rig_foot: (3, 3) orientation as in `FootPose`.
            up: (3,) unit vector against gravity, rig frame.
        """
        seen = R_rig_foot.T @ up
        # A foot that stands is tipped by no more than an instep.
        if seen[1] < math.cos(math.acos(0.77)):
            return
        # Weight of each sample of a stand in how the marker sits on the instep.
        self._up = self._up + 0.03 * (seen - self._up)
        self.R_foot_level = shortest_rotation(np.array([0.0, 1.0, 0.0]), self._up / np.linalg.norm(self._up))


@dataclass(frozen=True, slots=True)
class HipMotion:
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
    position: FloatArray
    velocity: FloatArray
    R: FloatArray
    rate: FloatArray
    sigma_m: float
    state: State
    stands: bool


class FootSample(Protocol):
    """One pose of a foot; `rhot.messages.FootPose` is one."""

    @property
    def t_ns(self) -> int:
        """Time, nanoseconds, rig clock."""
        ...

    @property
    def position(self) -> Vector3:
        """Origin of the foot, metres, rig frame."""
        ...

    @property
    def orientation(self) -> tuple[float, float, float, float]:
        """x, y, z, w, rotates the foot's axes into the rig frame."""
        ...

    @property
    def velocity(self) -> Vector3:
        """m/s, rig frame."""
        ...

    @property
    def sigma(self) -> float:
        """Standard deviation of the position, metres."""
        ...

    @property
    def state(self) -> State:
        """Whether it is measured."""
        ...

    @property
    def stationary(self) -> bool:
        """The foot stands."""
        ...


class FootTrack:
    """Follows one foot.

    Args:
        ankle_m: (3,) position of the ankle in the frame of `FootPose`.
        usual_m: (3,) where the ankle usually is in the frame of the hips, as long as nothing else is learned.
        up: (3,) unit vector against gravity, rig frame.
    """

    def __init__(self, ankle_m: FloatArray, usual_m: FloatArray, up: FloatArray) -> None:
        self._ankle_m = ankle_m
        self._usual_m = usual_m.copy()
        self._up = up
        self._level = SoleLevel()
        self._floor_m = -math.inf
        self._sample: _Sample | None = None
        self._last: Ankle | None = None
        self._trusted_ns: int | None = None
        self._velocity = np.zeros(3)
        self._t_ns = 0

    def update(self, foot: FootSample) -> None:
        """Update with a pose of the foot."""
        R_rig_foot = rotation_from_quaternion(np.array(foot.orientation))
        position = R_rig_foot @ self._ankle_m + np.array(foot.position)
        stands = foot.stationary and foot.state == "measured"
        if stands:
            self._level.update(R_rig_foot, self._up)
            self._floor_m = float(position @ self._up)
        R = R_rig_foot @ self._level.R_foot_level
        rate = np.zeros(3) if self._sample is None else _rate(self._sample, foot.t_ns, R)
        # The ankle of a foot that lifts its heel moves while its marker hardly does.
        velocity = np.array(foot.velocity) + np.cross(rate, R_rig_foot @ self._ankle_m)
        sample = _Sample(foot.t_ns, position, velocity, R, rate, foot.sigma, foot.state, stands)
        if self._last is not None and self._sample is not None and _jumps(self._sample, sample):
            self._last = Ankle(self._last.T_rig_ankle, 0.0)
        self._sample = sample

    @property
    def state(self) -> State | None:
        """Whether the ankle that was last asked for is measured or predicted; None when it is not known."""
        # A foot that was only guessed for so long is not known: its knee is 170 mm off from then on.
        if self._sample is None or self._trusted_ns is None or self._t_ns - self._trusted_ns > 200_000_000:
            return None
        return self._sample.state if self._trusted_ns == self._t_ns else "predicted"

    @property
    def stands(self) -> bool:
        """The foot was just seen to stand still."""
        return (
            self._sample is not None
            and self._sample.stands
            and self._last is not None
            and self._last.trust > _LEARNING_TRUST
        )

    def at(self, t_ns: int, hip_motion: HipMotion | None, higher_m: float = 0.0) -> Ankle | None:
        """Return the ankle at a moment, later than any asked for before; None when the foot was never heard of.

        Args:
            t_ns: the moment, rig clock.
            hip_motion: the hips, if they are known.
            higher_m: how much higher the ankle is in the foot than configured.
        """
        if self._sample is None:
            return None
        sample, age_s = self._sample, 1e-9 * (t_ns - self._sample.t_ns)
        seen = sample.position + min(age_s, LEAD_S) * sample.velocity + higher_m * sample.R[:, 1]
        # A foot whose position is known this well is trusted entirely.
        # How much worse a foot is known per second without a message.
        doubt_m = max(sample.sigma_m - 0.03, 0.0) + 1.5 * max(age_s, 0.0)
        # How far off the pendulum is.
        trust = 1.0 / (1.0 + (doubt_m / 0.1) ** 4)
        if self._last is None or hip_motion is None:
            ankle, velocity = Ankle(rigid(sample.R, seen), trust), sample.velocity
        else:
            # A longer pause counts as one of this length.
            elapsed_s = min(max(1e-9 * (t_ns - self._t_ns), 0.0), 0.1)
            position, velocity = self._pendulum(self._last.position, hip_motion, elapsed_s)
            catch_up_m = 0.01 + 6.0 * elapsed_s
            reached = catch_up_m / max(float(np.linalg.norm(seen - position)), catch_up_m)
            # Trust in a foot that is found again comes back over so
            # long, and no faster than the foot moves there.
            trust = min(trust, self._last.trust + elapsed_s / 0.1, reached)
            R = self._levelled(self._last.T_rig_ankle[:3, :3], hip_motion.T_rig_hips[:3, :3], elapsed_s)
            R = orthonormal(rotation_from_vector(trust * rotation_between(R, sample.R)) @ R)
            ankle = Ankle(rigid(R, position + trust * (seen - position)), trust)
            velocity = velocity + trust * (sample.velocity - velocity)
            self._update_usual(ankle, hip_motion, elapsed_s)
        self._last, self._velocity, self._t_ns = ankle, velocity, t_ns
        if ankle.trust >= 0.5:
            self._trusted_ns = t_ns
        return ankle

    def _pendulum(self, position: FloatArray, hip_motion: HipMotion, elapsed_s: float) -> tuple[FloatArray, FloatArray]:
        """Return position and velocity (3,) of the pendulum a little later; it does not swing through the floor."""
        usual = hip_motion.T_rig_hips[:3, :3] @ self._usual_m + hip_motion.T_rig_hips[:3, 3]
        pull = _RATE**2 * (usual - position) - 2.0 * 0.6 * _RATE * (self._velocity - hip_motion.velocity)
        velocity = self._velocity + elapsed_s * pull
        position = position + elapsed_s * velocity
        under_m = self._floor_m - float(position @ self._up)
        if under_m > 0.0:
            position = position + under_m * self._up
            velocity = velocity - min(float(velocity @ self._up), 0.0) * self._up
        return position, velocity

    def _levelled(self, R: FloatArray, R_rig_hips: FloatArray, elapsed_s: float) -> FloatArray:
        """Return a foot's rotation a little later: an unseen foot becomes level and points straight ahead."""
        # Time in which an unseen foot becomes level.
        share = -math.expm1(-elapsed_s / 0.3)
        return rotation_from_vector(share * rotation_between(R, R_rig_hips)) @ R

    def _update_usual(self, ankle: Ankle, hip_motion: HipMotion, elapsed_s: float) -> None:
        if ankle.trust < _LEARNING_TRUST:
            return
        hips = hip_motion.T_rig_hips
        position = hips[:3, :3].T @ (ankle.T_rig_ankle[:3, 3] - hips[:3, 3])
        # Over which its usual position under the hips is averaged.
        self._usual_m += -math.expm1(-elapsed_s / 2.0) * (position - self._usual_m)


def _rate(before: _Sample, t_ns: int, R: FloatArray) -> FloatArray:
    """Return the smoothed angular rate of a foot (3,), rad/s, rig frame."""
    elapsed_s = 1e-9 * (t_ns - before.t_ns)
    if not 0.0 < elapsed_s < LEAD_S:
        return np.zeros(3)
    measured = rotation_between(before.R, R) / elapsed_s
    # Over which a foot's angular rate is averaged.
    rate: FloatArray = before.rate - math.expm1(-elapsed_s / 0.04) * (measured - before.rate)
    return rate


def _jumps(before: _Sample, after: _Sample) -> bool:
    """Return whether a foot's rotation jumps."""
    elapsed_s = max(1e-9 * (after.t_ns - before.t_ns), 0.0)
    return (
        # Rotation from one sample to the next, plus so much per second, that is no
        # jump.
        float(np.linalg.norm(rotation_between(before.R, after.R))) > 0.35 + 15.0 * elapsed_s
    )
