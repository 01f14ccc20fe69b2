"""The foot without an inertial sensor, or before that is aligned: `FootModel` of a body that accelerates at random.

Place, velocity and acceleration, the last fading with `_FADES_S` (Singer 1970, "Estimating optimal tracking filter
performance for manned maneuvering targets", IEEE Transactions on Aerospace and Electronic Systems 6 (4)); how strong it
is follows from how surprising the observations were, so that a foot that stands is smoothed and one that swings is
followed; a sensor on the foot, aligned or not, tells at once when it is accelerated. Orientation turns on at a random
rate that fades likewise. Unseen for longer than `_SEEN_S` the foot comes to rest instead of flying off.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Final

import numpy as np
from numpy.typing import NDArray

from rhot.geometry.covariances import squared_distance
from rhot.geometry.rotations import orthonormal, rotation_between, rotation_from_vector
from rhot_feet.filter.kalman import kalman_gain
from rhot_feet.filter.model import FootMotion, Observation
from rhot_feet.imu.strapdown import InertialStep
from rhot_feet.imu.zero_velocity import GRAVITY

FloatArray = NDArray[np.float64]

_FADES_S: Final = 0.12
_SEEN_S: Final = 0.1
_STOPS_S: Final = 0.06
"""Time constant of the velocity once the foot is unseen."""
_CALMEST: Final = 0.5
_WILDEST: Final = 25.0
"""Bounds of the standard deviation of the acceleration, m/s²."""
_TURNS_WITH: Final = 3.0
"""Acceleration that goes with a rate of turning, m/s² per rad/s: a heel is lifted slowly before the foot swings."""
_QUICK: Final = 0.25
"""How fast it follows the surprise of the observations."""
_ROOM_M: Final = 0.01
_SETS_OFF: Final = 20.0
"""m/s²; the acceleration with which a foot sets off, one standard deviation."""
_STRAYS: Final = 1.5
"""m/s; how fast a foot that is not seen moves, one standard deviation."""
_CALMS: Final = 1.25
"""Mean squared normalised innovation below which it falls; a little above 1, so that noise alone calms."""
_TURNING: Final = 6.0
"""Standard deviation of the rate of turning, rad/s."""
_TURNING_AT_REST: Final = 0.01
_MOST_TURNED: Final = math.radians(45.0)
"""A foot whose orientation was seen does not come to be turned by more meanwhile, per axis, one standard deviation."""
_UNIT: Final = np.eye(3)
_PLACE: Final = np.concatenate([_UNIT, np.zeros((3, 6))], axis=1)
_REST: Final = np.concatenate([np.zeros((6, 3)), np.eye(6)], axis=1)
_ACCELERATION_AT_REST: Final = 0.5
"""m/s²"""


@dataclass(frozen=True, slots=True)
class KinematicState:
    """A foot at one moment.

    Attributes:
        motion: (9,) position, velocity and acceleration, metres and seconds, rig frame.
        P: (9, 9) their covariance.
        R: R_rig_foot (3, 3).
        rate: (3,) rad/s, rig frame.
        turning: (2, 2) covariance of orientation and rate, the same for each axis.
        liveliness: standard deviation of the acceleration, m/s².
        unseen_s: since the last observation or stand-still.
    """

    motion: FloatArray
    P: FloatArray
    R: FloatArray
    rate: FloatArray
    turning: FloatArray
    liveliness: float
    unseen_s: float


class KinematicModel:
    """The filter of a foot that only pictures show."""

    def start(self, position: FloatArray, covariance: FloatArray, rotation: FloatArray | None) -> KinematicState:
        """Return a state of which only the place, and perhaps the orientation, is known."""
        P = np.zeros((9, 9))
        P[:3, :3], P[3:6, 3:6], P[6:, 6:] = covariance, _UNIT, 4.0 * _UNIT
        turning = np.diag([math.radians(5.0 if rotation is not None else 90.0) ** 2, 1.0])
        R = _UNIT if rotation is None else rotation
        return KinematicState(np.r_[position, np.zeros(6)], P, R, np.zeros(3), turning, 5.0, 0.0)

    def follow(self, motion: FootMotion) -> KinematicState:
        """Return the state that continues a motion."""
        state = self.start(motion.position, motion.covariance, motion.rotation)
        state.motion[3:6] = motion.velocity
        return state

    def predict(self, state: KinematicState, duration_s: float, step: InertialStep | None) -> KinematicState:
        """Return the state `duration_s` later; a sensor only tells how strongly the foot is accelerated at least."""
        if step is not None:
            force = math.sqrt(float(step.force_after @ step.force_after))
            turning = math.sqrt(float(step.turn_rad @ step.turn_rad)) / step.duration_s
            liveliness = min(max(abs(force - GRAVITY), _TURNS_WITH * turning), _WILDEST)
            if liveliness > state.liveliness:
                state = replace(state, liveliness=liveliness)
        seen_s = _SEEN_S - state.unseen_s
        if 0.0 < seen_s < duration_s:
            state, duration_s = self.predict(state, seen_s, step), duration_s - seen_s
        h = duration_s
        fades = math.exp(-h / _FADES_S)
        path = _FADES_S * (1.0 - fades)
        keeps, glides = 1.0, h
        if state.unseen_s >= _SEEN_S:
            keeps = math.exp(-h / _STOPS_S)
            glides = _STOPS_S * (1.0 - keeps)
        F = np.array(
            [
                [1.0, glides, _FADES_S * (h - path) if keeps == 1.0 else 0.0],
                [0.0, keeps, path if keeps == 1.0 else 0.0],
                [0.0, 0.0, fades],
            ]
        )
        q = 2.0 * state.liveliness**2 / _FADES_S
        Q = q * np.array(
            [
                [h**5 / 20.0, h**4 / 8.0, h**3 / 6.0],
                [h**4 / 8.0, h**3 / 3.0, h**2 / 2.0],
                [h**3 / 6.0, h**2 / 2.0, h],
            ]
        )
        G = _on_each_axis(F)
        P = G @ state.P @ G.T + _on_each_axis(Q)
        if state.unseen_s >= _SEEN_S:
            P[:3, :3] += _STRAYS**2 * (2.0 * state.unseen_s + h) * h * _UNIT
        A = np.array([[1.0, path], [0.0, fades]])
        w = 2.0 * _TURNING**2 / _FADES_S
        turning = A @ state.turning @ A.T + w * np.array([[h**3 / 3.0, h**2 / 2.0], [h**2 / 2.0, h]])
        most = max(_MOST_TURNED**2, float(state.turning[0, 0]))
        if turning[0, 0] > most:
            within = np.array([math.sqrt(most / turning[0, 0]), 1.0])
            turning *= np.outer(within, within)
        return KinematicState(
            G @ state.motion,
            P,
            orthonormal(rotation_from_vector(path * state.rate) @ state.R),
            fades * state.rate,
            turning,
            state.liveliness,
            max(state.unseen_s + h, _SEEN_S) if h == seen_s else state.unseen_s + h,
        )

    def surprise(self, state: KinematicState, observation: Observation) -> tuple[float, float]:
        """Return the squared normalised innovations of position and rotation."""
        residual = observation.position - state.motion[:3]
        S = state.P[:3, :3] + observation.covariance + room_m(state.unseen_s) ** 2 * _UNIT
        position = squared_distance(residual, S)
        if observation.rotation is None:
            return position, 0.0
        turned = rotation_between(state.R, observation.rotation)
        S = state.turning[0, 0] * _UNIT + observation.rotation_covariance
        return position, squared_distance(turned, S)

    def observe(self, state: KinematicState, observation: Observation) -> KinematicState:
        """Return the state after an observation of its moment."""
        residual = observation.position - state.motion[:3]
        S = state.P[:3, :3] + observation.covariance
        surprise = squared_distance(residual, S) / 3.0
        motion, P = _correct(state.motion, state.P, _PLACE, residual, observation.covariance)
        R, rate, turning = state.R, state.rate, state.turning
        if observation.rotation is not None:
            # One gain for all axes: an orientation out of a picture is worst about the line of sight's normals, but
            # without a sensor nothing better is known about any of them.
            noise = float(np.trace(observation.rotation_covariance)) / 3.0
            gain = turning[:, 0] / (turning[0, 0] + noise)
            turned = rotation_between(R, observation.rotation)
            R, rate = orthonormal(rotation_from_vector(gain[0] * turned) @ R), rate + gain[1] * turned
            turning = turning - np.outer(gain, turning[0])
        liveliness = state.liveliness * math.exp(_QUICK * (min(surprise, 5.0) - _CALMS))
        return KinematicState(motion, P, R, rate, turning, min(max(liveliness, _CALMEST), _WILDEST), 0.0)

    def rest(self, state: KinematicState, speed_sigma: float, gate: float | None) -> KinematicState:
        """Return the state after a sensor on the foot felt that it stands."""
        velocity = state.motion[3:6]
        if gate is not None:
            S = state.P[3:6, 3:6] + speed_sigma**2 * _UNIT
            if squared_distance(velocity, S) > gate:
                return state
        noise = np.diag(np.repeat([speed_sigma**2, _ACCELERATION_AT_REST**2], 3))
        motion, P = _correct(state.motion, state.P, _REST, -state.motion[3:], noise)
        turning = np.diag([state.turning[0, 0], _TURNING_AT_REST**2])
        return replace(state, motion=motion, P=P, rate=np.zeros(3), turning=turning, liveliness=_CALMEST, unseen_s=0.0)

    def rest_turning(self, state: KinematicState, angular_rate: FloatArray, duration_s: float) -> KinematicState:
        """Return the state as it is: there is no bias to learn."""
        return state

    def motion(self, state: KinematicState, angular_rate: FloatArray) -> FootMotion:
        """Return where the foot is; what a sensor feels does not count."""
        return FootMotion(
            state.motion[:3].copy(),
            state.motion[3:6].copy(),
            state.R,
            state.P[:3, :3].copy(),
            state.turning[0, 0] * _UNIT,
        )


def _on_each_axis(matrix: FloatArray) -> FloatArray:
    """Return the Kronecker product (9, 9) of a matrix (3, 3) with the unit matrix; faster than `np.kron`."""
    return (matrix[:, None, :, None] * _UNIT[None, :, None, :]).reshape(9, 9)


def room_m(unseen_s: float) -> float:
    """Return by how much a foot may have left its course since it was seen: one that stood may set off at any time."""
    bend_s = min(unseen_s, _SEEN_S)
    return _ROOM_M + 0.5 * _SETS_OFF * bend_s**2 + _STRAYS * (unseen_s - bend_s)


def _correct(
    x: FloatArray, P: FloatArray, H: FloatArray, residual: FloatArray, noise: FloatArray
) -> tuple[FloatArray, FloatArray]:
    PHt = P @ H.T
    K = kalman_gain(PHt, H, noise)
    A = np.eye(len(x)) - K @ H
    return x + K @ residual, A @ P @ A.T + K @ noise @ K.T
