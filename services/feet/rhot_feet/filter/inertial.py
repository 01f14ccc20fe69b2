"""The foot by its inertial sensor, corrected by pictures and stand-stills: `FootModel` over `imu.strapdown`."""

from __future__ import annotations

from typing import Final

import numpy as np
from numpy.typing import NDArray

from rhot.geometry.covariances import squared_distance
from rhot.geometry.rotations import cross_matrix, rotation_between, rotation_z
from rhot_feet.filter.model import FootMotion, Observation
from rhot_feet.imu.alignment.equations import Alignment
from rhot_feet.imu.strapdown import (
    ACCELEROMETER,
    ATTITUDE,
    GYROSCOPE,
    LEVER,
    MOUNTING,
    POSITION,
    SIZE,
    VELOCITY,
    InertialState,
    InertialStep,
    Strapdown,
    correct,
)

FloatArray = NDArray[np.float64]

_TILT_RAD: Final = float(np.radians(1.5))
"""How wrong a sensor's own idea of up may be at the start."""
_RATE_BIAS: Final = float(np.radians(0.3))
"""rad/s; a BNO080 has removed its bias, a raw sensor has been still at some time."""
_MOUNTING_RAD: Final = float(np.radians(3.0))
_SPEED_AT_REST: Final = 0.02
_SPEED_IN_MOTION: Final = 1.5
"""How wrong the velocity may be at the start, m/s per axis."""
_UNMOUNTED_RAD: Final = float(np.radians(90.0))
_MOUNTED_RAD: Final = float(np.radians(20.0))
"""A mounting known better than this, over all axes, serves a sensor that comes back."""
_RATE_AT_REST: Final = float(np.radians(3.0))
"""Noise of the rate as a measure of its bias while nothing turns, rad/s, for one sample of 5 ms."""
_MOST_RATE: Final = float(np.radians(1.0))
"""rad/s; what turns faster than its bias allows does turn, however evenly."""
_UNIT: Final = np.eye(3)


class InertialModel:
    """The error-state filter of a foot whose sensor is aligned."""

    def __init__(self, strapdown: Strapdown, C: FloatArray) -> None:
        """Set the frame.

        Args:
            strapdown: of the sensor.
            C: (3, 3) from level axes (z up) to the rig frame.
        """
        self._strapdown = strapdown
        self._C = C

    def start(
        self,
        alignment: Alignment,
        R_world_sensor: FloatArray,
        motion: FootMotion,
        angular_rate: FloatArray,
        *,
        stands: bool,
    ) -> InertialState:
        """Return the first state.

        Args:
            alignment: of the sensor.
            R_world_sensor: (3, 3) its orientation at the moment, by itself.
            motion: the foot at the moment.
            angular_rate: (3,) rad/s at the moment, sensor frame.
            stands: the foot was felt to stand.
        """
        R = self._C @ rotation_z(alignment.yaw_rad) @ R_world_sensor
        arm = R @ alignment.lever
        up = self._C[:, 2]
        # What is wrong for reasons of its own: place and velocity of the foot, attitude, and so on.
        source = np.zeros((SIZE, SIZE))
        source[POSITION, POSITION] = motion.covariance + (0.01**2) * _UNIT
        source[VELOCITY, VELOCITY] = (_SPEED_AT_REST if stands else _SPEED_IN_MOTION) ** 2 * _UNIT
        source[ATTITUDE, ATTITUDE] = _TILT_RAD**2 * _UNIT + alignment.yaw_sigma_rad**2 * np.outer(up, up)
        source[LEVER, LEVER] = alignment.covariance[:3, :3] + 0.01**2 * _UNIT
        source[ACCELEROMETER, ACCELEROMETER] = alignment.covariance[3:, 3:] + 0.03**2 * _UNIT
        source[GYROSCOPE, GYROSCOPE] = _RATE_BIAS**2 * _UNIT
        source[MOUNTING, MOUNTING] = (_MOUNTING_RAD if alignment.mounted else _UNMOUNTED_RAD) ** 2 * _UNIT
        # And what follows: lever and bias from the yaw, the sensor's place from the lever, for the foot's is known,
        # and the mounting from the attitude, for the foot's orientation is.
        follows = np.eye(SIZE)
        follows[LEVER, ATTITUDE] = np.outer(alignment.by_yaw[:3], up)
        follows[ACCELEROMETER, ATTITUDE] = np.outer(alignment.by_yaw[3:], up)
        follows[POSITION, LEVER] = -R
        follows[POSITION, ATTITUDE] = cross_matrix(arm) - R @ follows[LEVER, ATTITUDE]
        if alignment.mounted:
            follows[MOUNTING, ATTITUDE] = -R.T
        return InertialState(
            motion.position - arm,
            np.zeros(3) if stands else motion.velocity - R @ np.cross(angular_rate, alignment.lever),
            R,
            alignment.bias.copy(),
            np.zeros(3),
            alignment.lever.copy(),
            alignment.M if alignment.mounted else R.T @ motion.rotation,
            follows @ source @ follows.T,
        )

    def restart(self, state: InertialState, observation: Observation) -> InertialState:
        """Return a state at an observed place that keeps what was learnt about the sensor."""
        R = state.R
        P = state.P.copy()
        for part, sigma in ((POSITION, 0.02), (VELOCITY, 1.0)):
            P[part, :], P[:, part] = 0.0, 0.0
            P[part, part] = sigma**2 * _UNIT
        P[ATTITUDE, ATTITUDE] += np.radians(3.0) ** 2 * _UNIT
        P[POSITION, POSITION] += observation.covariance
        return InertialState(
            observation.position - R @ state.lever,
            np.zeros(3),
            R,
            state.acceleration_bias,
            state.rate_bias,
            state.lever,
            state.M,
            P,
        )

    def learnt(self, state: InertialState) -> Alignment:
        """Return what is known of lever and mounting when the sensor goes away; its yaw may be another afterwards."""
        covariance = np.zeros((6, 6))
        covariance[:3, :3], covariance[3:, 3:] = state.P[LEVER, LEVER], state.P[ACCELEROMETER, ACCELEROMETER]
        mounted = float(np.trace(state.P[MOUNTING, MOUNTING])) < _MOUNTED_RAD**2
        lever, bias, M = state.lever.copy(), state.acceleration_bias.copy(), state.M.copy()
        return Alignment(0.0, np.pi, lever, bias, covariance, np.zeros(6), M, mounted)

    def predict(self, state: InertialState, duration_s: float, step: InertialStep | None) -> InertialState:
        """Return the state after what the sensor felt; without a step it floats on evenly."""
        if step is None:
            still = state.R.T @ (-self._strapdown.gravity) + state.acceleration_bias
            step = InertialStep(duration_s, still, still, duration_s * state.rate_bias, unfelt=True)
        return self._strapdown.predict(state, step)

    def surprise(self, state: InertialState, observation: Observation) -> tuple[float, float]:
        """Return the squared normalised innovations of position and rotation."""
        H, residual, noise = self._linearised(state, observation)
        S = H @ state.P @ H.T + noise
        position = squared_distance(residual[:3], S[:3, :3])
        if observation.rotation is None:
            return position, 0.0
        return position, squared_distance(residual[3:], S[3:, 3:])

    def observe(self, state: InertialState, observation: Observation) -> InertialState:
        """Return the state after an observation of its moment."""
        return correct(state, *self._linearised(state, observation))

    def rest(self, state: InertialState, speed_sigma: float, gate: float | None) -> InertialState:
        """Return the state after the sensor's velocity was felt to be zero."""
        noise = speed_sigma**2 * _UNIT
        if gate is not None:
            S = state.P[VELOCITY, VELOCITY] + noise
            if squared_distance(state.velocity, S) > gate:
                return state
        return correct(state, _SPEED, -state.velocity, noise)

    def rest_turning(self, state: InertialState, angular_rate: FloatArray, duration_s: float) -> InertialState:
        """Return the state after the sensor was felt not to turn: its rate is its bias."""
        residual = angular_rate - state.rate_bias
        if residual @ residual > _MOST_RATE**2:
            return state
        return correct(state, _RATE, residual, (_RATE_AT_REST**2 * 0.005 / duration_s) * _UNIT)

    def motion(self, state: InertialState, angular_rate: FloatArray) -> FootMotion:
        """Return where the foot is."""
        arm = state.R @ state.lever
        H = np.zeros((3, SIZE))
        H[:, POSITION], H[:, ATTITUDE], H[:, LEVER] = _UNIT, -cross_matrix(arm), state.R
        turning = state.R @ (angular_rate - state.rate_bias)
        G = np.zeros((3, SIZE))
        G[:, ATTITUDE], G[:, MOUNTING] = _UNIT, state.R
        return FootMotion(
            state.position + arm,
            state.velocity + cross_matrix(turning) @ arm,
            state.foot_rotation,
            H @ state.P @ H.T,
            G @ state.P @ G.T,
        )

    @staticmethod
    def _linearised(state: InertialState, observation: Observation) -> tuple[FloatArray, FloatArray, FloatArray]:
        rows = 3 if observation.rotation is None else 6
        H, residual, noise = np.zeros((rows, SIZE)), np.empty(rows), np.zeros((rows, rows))
        arm = state.R @ state.lever
        H[:3, POSITION], H[:3, ATTITUDE], H[:3, LEVER] = _UNIT, -cross_matrix(arm), state.R
        residual[:3] = observation.position - state.position - arm
        noise[:3, :3] = observation.covariance
        if observation.rotation is not None:
            H[3:, ATTITUDE], H[3:, MOUNTING] = _UNIT, state.R
            residual[3:] = rotation_between(state.foot_rotation, observation.rotation)
            noise[3:, 3:] = observation.rotation_covariance
        return H, residual, noise


_SPEED: Final = np.zeros((3, SIZE))
_SPEED[:, VELOCITY] = _UNIT
_RATE: Final = np.zeros((3, SIZE))
_RATE[:, GYROSCOPE] = _UNIT
