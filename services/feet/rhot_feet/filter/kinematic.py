"""The foot without an inertial sensor, or before it is aligned: `FootModel` of a body that accelerates at random.

Position, velocity and acceleration, the last fading exponentially (Singer 1970, "Estimating optimal tracking filter
performance for manned maneuvering targets", IEEE Transactions on Aerospace and Electronic Systems 6 (4)). Its strength
follows the NIS of the observations, so that a standing foot is smoothed and a swinging one is followed; a sensor on the
foot, aligned or not, shows at once when it is accelerated. Orientation goes on at a random rate that fades likewise.
Unseen for longer than `seen_s` the foot comes to rest instead of flying off.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Final

import numpy as np

from rhot.arrays import FloatArray
from rhot.geometry.covariances import squared_distance
from rhot.geometry.rotations import orthonormal, rotation_between, rotation_from_vector
from rhot_feet.filter.model import FootMotion, Observation
from rhot_feet.imu.samples import GRAVITY_M_S2
from rhot_feet.imu.track import InertialStep

_CORRELATION_S: Final = 0.12
"""Time constant of acceleration and angular rate."""
_SEEN_S: Final = 0.1
"""After so long without an observation the foot comes to rest."""
_STOP_S: Final = 0.06
"""Time constant of the velocity from then on."""
_MIN_ACCELERATION_M_S2: Final = 0.5
"""Bounds of the standard deviation of the acceleration."""
_MAX_ACCELERATION_M_S2: Final = 25.0
"""Upper bound of the standard deviation of the acceleration."""
_SET_OFF_M_S2: Final = 20.0
"""Acceleration with which a standing foot sets off, one sigma. Gates allow for it at all times, the filter where an
observation shows it, and what is called measured ends with it.
"""
_UNSEEN_SPEED_M_S: Final = 1.5
"""How fast a foot that is not seen moves, one sigma."""


_UNIT: Final = np.eye(3)
_H_POSITION: Final = np.concatenate([_UNIT, np.zeros((3, 6))], axis=1)
_H_REST: Final = np.concatenate([np.zeros((6, 3)), np.eye(6)], axis=1)


def set_off_m(unseen_s: float) -> float:
    """Return how far a foot that stood may have gone since it was seen, one sigma, until it comes to rest."""
    return 0.5 * _SET_OFF_M_S2 * min(max(unseen_s, 0.0), _SEEN_S) ** 2


def unseen_error_m(unseen_s: float) -> float:
    """Return how far a foot may have left its course since it was seen: one that stood may set off at any time."""
    unseen_m = _UNSEEN_SPEED_M_S * max(unseen_s - _SEEN_S, 0.0)
    # Model error that the gate leaves room for.
    return 0.01 + set_off_m(unseen_s) + unseen_m


@dataclass(frozen=True, slots=True)
class KinematicState:
    """A foot at one moment.

    Attributes:
        motion: (9,) position, velocity and acceleration, metres and seconds, rig frame.
        P: (9, 9) their covariance.
        R: R_rig_foot (3, 3).
        rate: (3,) rad/s, rig frame.
        rotation_covariance: (2, 2) covariance of orientation and rate, the same for each axis.
        acceleration_sigma: standard deviation of the acceleration, m/s².
        unseen_s: since the last observation or stand-still.
    """

    motion: FloatArray
    P: FloatArray
    R: FloatArray
    rate: FloatArray
    rotation_covariance: FloatArray
    acceleration_sigma: float
    unseen_s: float


class KinematicModel:
    """The filter of a foot that only pictures show."""

    def start(self, position: FloatArray, covariance: FloatArray, rotation: FloatArray | None) -> KinematicState:
        """Return a state of which only the position, and perhaps the orientation, is known.

        Args:
            position: (3,) metres, rig frame.
            covariance: (3, 3) of it, m².
            rotation: (3, 3) foot to rig, if it was seen.
        """
        P = np.zeros((9, 9))
        # Standard deviations at the start.
        P[:3, :3], P[3:6, 3:6] = covariance, 1.0**2 * _UNIT
        P[6:, 6:] = 2.0**2 * _UNIT
        # Standard deviation of the orientation at the start, seen and not seen.
        start_rad = math.radians(90.0) if rotation is None else math.radians(5.0)
        rotation_covariance = np.diag([start_rad**2, 1.0**2])
        R = _UNIT if rotation is None else rotation
        return KinematicState(
            # Standard deviation of the acceleration that a track starts with.
            np.r_[position, np.zeros(6)],
            P,
            R,
            np.zeros(3),
            rotation_covariance,
            5.0,
            0.0,
        )

    def follow(self, motion: FootMotion) -> KinematicState:
        """Return the state that continues a motion."""
        state = self.start(motion.position, motion.covariance, motion.rotation)
        state.motion[3:6] = motion.velocity
        return state

    def predict(self, state: KinematicState, duration_s: float, step: InertialStep | None) -> KinematicState:
        """Return the state `duration_s` later; a sensor only shows how strongly the foot is accelerated at least."""
        if step is not None:
            state = replace(state, acceleration_sigma=max(_shown_acceleration(step), state.acceleration_sigma))
        seen_s = _SEEN_S - state.unseen_s
        if 0.0 < seen_s < duration_s:
            state, duration_s = self.predict(state, seen_s, step), duration_s - seen_s
        h, unseen = duration_s, state.unseen_s >= _SEEN_S
        fades = math.exp(-h / _CORRELATION_S)
        path = _CORRELATION_S * (1.0 - fades)
        F = _on_each_axis(_transition(h, unseen=unseen))
        P = F @ state.P @ F.T + _on_each_axis(_process_noise(h, state.acceleration_sigma))
        if unseen:
            P[:3, :3] += _UNSEEN_SPEED_M_S**2 * (2.0 * state.unseen_s + h) * h * _UNIT
        return KinematicState(
            F @ state.motion,
            P,
            orthonormal(rotation_from_vector(path * state.rate) @ state.R),
            fades * state.rate,
            _rotation_covariance(state.rotation_covariance, h),
            state.acceleration_sigma,
            max(state.unseen_s + h, _SEEN_S) if h == seen_s else state.unseen_s + h,
        )

    def nis(self, state: KinematicState, observation: Observation) -> tuple[float, float]:
        """Return the squared normalised innovations of position and rotation."""
        residual = observation.position - state.motion[:3]
        S = state.P[:3, :3] + observation.covariance + unseen_error_m(state.unseen_s) ** 2 * _UNIT
        position = squared_distance(residual, S)
        if observation.rotation is None:
            return position, 0.0
        residual = rotation_between(state.R, observation.rotation)
        S = state.rotation_covariance[0, 0] * _UNIT + observation.rotation_covariance
        return position, squared_distance(residual, S)

    def update(self, state: KinematicState, observation: Observation) -> KinematicState:
        """Return the state after an observation of its moment."""
        residual = observation.position - state.motion[:3]
        S = state.P[:3, :3] + observation.covariance
        nis = squared_distance(residual, S) / 3.0
        P = state.P
        # Squared normalised innovation (3 degrees of freedom) above which the foot has set off: 99.9 %.
        if 3.0 * nis > 16.3:
            # Only a foot that set off unseen can be there, so it is one: position, velocity and acceleration follow.
            bend_s = min(state.unseen_s, _SEEN_S)
            set_off = np.array([0.5 * bend_s**2, bend_s, 1.0])
            P = P + _on_each_axis(_SET_OFF_M_S2**2 * np.outer(set_off, set_off))
        motion, P = _correct(state.motion, P, _H_POSITION, residual, observation.covariance)
        R, rate, rotation_covariance = state.R, state.rate, state.rotation_covariance
        if observation.rotation is not None:
            # One gain for all axes: an orientation out of a picture is worst about the line of sight's normals, but
            # without a sensor nothing better is known about any of them.
            noise = float(np.trace(observation.rotation_covariance)) / 3.0
            gain = rotation_covariance[:, 0] / (rotation_covariance[0, 0] + noise)
            residual = rotation_between(R, observation.rotation)
            R, rate = orthonormal(rotation_from_vector(gain[0] * residual) @ R), rate + gain[1] * residual
            rotation_covariance = rotation_covariance - np.outer(gain, rotation_covariance[0])
        acceleration_sigma = state.acceleration_sigma * math.exp(
            # The standard deviation of the acceleration follows the NIS per axis by a quarter. It falls below
            # 1.25, above 1 so that noise alone calms; more than 5 raises it no faster.
            0.25 * (min(nis, 5.0) - 1.25)
        )
        return KinematicState(
            motion,
            P,
            R,
            rate,
            rotation_covariance,
            min(max(acceleration_sigma, _MIN_ACCELERATION_M_S2), _MAX_ACCELERATION_M_S2),
            0.0,
        )

    def zero_velocity_update(
        self, state: KinematicState, speed_sigma: float, gate_nis: float | None, rolling: FloatArray | None = None
    ) -> KinematicState:
        """Return the state after the sensor's velocity was measured to be zero; unchanged when its NIS is too high.

        Where a foot rolls to is not known of a sensor that is not aligned.
        """
        # A sensor that is known to stand no better than this does not end a motion.
        if speed_sigma > 0.15:
            return state
        S = state.P[3:6, 3:6] + speed_sigma**2 * _UNIT
        if gate_nis is not None and squared_distance(state.motion[3:6], S) > gate_nis:
            return state
        noise = np.diag(np.repeat([speed_sigma**2, 0.5**2], 3))
        motion, P = _correct(state.motion, state.P, _H_REST, -state.motion[3:], noise)
        # What is left of rate and acceleration at zero
        # velocity.
        rotation_covariance = np.diag([state.rotation_covariance[0, 0], 0.01**2])
        return replace(
            state,
            motion=motion,
            P=P,
            rate=np.zeros(3),
            rotation_covariance=rotation_covariance,
            acceleration_sigma=_MIN_ACCELERATION_M_S2,
            unseen_s=0.0,
        )

    def zero_rate_update(self, state: KinematicState, angular_rate: FloatArray, duration_s: float) -> KinematicState:
        """Return the state as it is: there is no bias to learn."""
        return state

    def motion(self, state: KinematicState, angular_rate: FloatArray) -> FootMotion:
        """Return where the foot is; what a sensor measures does not count."""
        return FootMotion(
            state.motion[:3].copy(),
            state.motion[3:6].copy(),
            state.R,
            state.P[:3, :3].copy(),
            state.rotation_covariance[0, 0] * _UNIT,
        )


def _shown_acceleration(step: InertialStep) -> float:
    """Return how strongly a sensor shows that its foot is accelerated at least, m/s²."""
    force = math.sqrt(float(step.force_after @ step.force_after))
    rate = math.sqrt(float(step.rotation_rad @ step.rotation_rad)) / step.duration_s
    # Acceleration that goes with a rate of rotation, m/s² per rad/s: a heel is lifted slowly before the foot
    # swings.
    return min(max(abs(force - GRAVITY_M_S2), 3.0 * rate), _MAX_ACCELERATION_M_S2)


def _transition(h: float, *, unseen: bool) -> FloatArray:
    """Return F (3, 3) of position, velocity and acceleration over h seconds; a foot that is not seen comes to rest."""
    fades = math.exp(-h / _CORRELATION_S)
    if unseen:
        keeps = math.exp(-h / _STOP_S)
        return np.array([[1.0, _STOP_S * (1.0 - keeps), 0.0], [0.0, keeps, 0.0], [0.0, 0.0, fades]])
    path = _CORRELATION_S * (1.0 - fades)
    return np.array([[1.0, h, _CORRELATION_S * (h - path)], [0.0, 1.0, path], [0.0, 0.0, fades]])


def _process_noise(h: float, acceleration_sigma: float) -> FloatArray:
    """Return Q (3, 3) of position, velocity and acceleration over h seconds; Singer's, for h below the correlation."""
    q = 2.0 * acceleration_sigma**2 / _CORRELATION_S
    return q * np.array(
        [
            [h**5 / 20.0, h**4 / 8.0, h**3 / 6.0],
            [h**4 / 8.0, h**3 / 3.0, h**2 / 2.0],
            [h**3 / 6.0, h**2 / 2.0, h],
        ]
    )


def _rotation_covariance(covariance: FloatArray, h: float) -> FloatArray:
    """Return the covariance (2, 2) of rotation and rate about each axis h seconds later; a rotation is bounded."""
    fades = math.exp(-h / _CORRELATION_S)
    A = np.array([[1.0, _CORRELATION_S * (1.0 - fades)], [0.0, fades]])
    # Standard deviation of the rate of rotation.
    w = 2.0 * 6.0**2 / _CORRELATION_S
    later: FloatArray = A @ covariance @ A.T + w * np.array([[h**3 / 3.0, h**2 / 2.0], [h**2 / 2.0, h]])
    # A foot whose orientation was seen does not rotate by more unseen, per axis, one sigma.
    most = max(math.radians(45.0) ** 2, float(covariance[0, 0]))
    if later[0, 0] > most:
        within = np.array([math.sqrt(most / later[0, 0]), 1.0])
        later *= np.outer(within, within)
    return later


def _on_each_axis(matrix: FloatArray) -> FloatArray:
    """Return the Kronecker product (9, 9) of a matrix (3, 3) with the unit matrix; faster than `np.kron`."""
    return (matrix[:, None, :, None] * _UNIT[None, :, None, :]).reshape(9, 9)


def _correct(
    x: FloatArray, P: FloatArray, H: FloatArray, residual: FloatArray, noise: FloatArray
) -> tuple[FloatArray, FloatArray]:
    PHt = P @ H.T
    K = np.linalg.solve(H @ PHt + noise, PHt.T).T
    A = np.eye(len(x)) - K @ H
    return x + K @ residual, A @ P @ A.T + K @ noise @ K.T
