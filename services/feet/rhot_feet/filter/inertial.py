"""The foot by its inertial sensor, corrected by pictures and zero velocity: `FootModel` over `strapdown`."""

from __future__ import annotations

import math
from typing import Final

import numpy as np

from rhot.arrays import FloatArray
from rhot.geometry.covariances import squared_distance
from rhot.geometry.rotations import cross_matrix, rotation_between, rotation_z
from rhot_feet.filter.model import FootMotion, Observation
from rhot_feet.filter.strapdown import (
    ACCELEROMETER,
    ATTITUDE,
    GYROSCOPE,
    LEVER,
    MOUNTING,
    POSITION,
    SIZE,
    VELOCITY,
    InertialState,
    Strapdown,
    correct,
)
from rhot_feet.imu.alignment.equations import Alignment
from rhot_feet.imu.track import InertialStep
from rhot_feet.imu.zero_velocity_detector import SAMPLE_S

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
            stands: the sensor shows zero velocity.
        """
        R = self._C @ rotation_z(alignment.yaw_rad) @ R_world_sensor
        arm = R @ alignment.lever
        up = self._C[:, 2]
        # Standard deviation of the velocity.
        speed = 0.02 if stands else 1.5
        # Standard deviation of the mounting, when the marker showed it and when not.
        mounting = math.radians(3.0) if alignment.mounting_known else math.radians(90.0)
        # Errors that are independent of each other.
        source = np.zeros((SIZE, SIZE))
        # Added to the standard deviations that the alignment states.
        source[POSITION, POSITION] = motion.covariance + 0.01**2 * _UNIT
        source[VELOCITY, VELOCITY] = speed**2 * _UNIT
        # Standard deviation of a sensor's own idea of up.
        source[ATTITUDE, ATTITUDE] = math.radians(1.5) ** 2 * _UNIT + alignment.yaw_sigma_rad**2 * np.outer(up, up)
        source[LEVER, LEVER] = alignment.covariance[:3, :3] + 0.01**2 * _UNIT
        source[ACCELEROMETER, ACCELEROMETER] = alignment.covariance[3:, 3:] + 0.03**2 * _UNIT
        # Bias of the gyroscope; a BNO080 has removed its bias, a raw sensor has been still at some time.
        source[GYROSCOPE, GYROSCOPE] = math.radians(0.3) ** 2 * _UNIT
        source[MOUNTING, MOUNTING] = mounting**2 * _UNIT
        # What follows from them: lever and bias from the yaw; the sensor's position from the lever, for the foot's is
        # known; and the mounting from the attitude, for the foot's orientation is known.
        follows = np.eye(SIZE)
        follows[LEVER, ATTITUDE] = np.outer(alignment.d_yaw[:3], up)
        follows[ACCELEROMETER, ATTITUDE] = np.outer(alignment.d_yaw[3:], up)
        follows[POSITION, LEVER] = -R
        follows[POSITION, ATTITUDE] = cross_matrix(arm) - R @ follows[LEVER, ATTITUDE]
        if alignment.mounting_known:
            follows[MOUNTING, ATTITUDE] = -R.T
        return InertialState(
            motion.position - arm,
            np.zeros(3) if stands else motion.velocity - R @ np.cross(angular_rate, alignment.lever),
            R,
            alignment.bias.copy(),
            np.zeros(3),
            alignment.lever.copy(),
            alignment.M if alignment.mounting_known else R.T @ motion.rotation,
            follows @ source @ follows.T,
        )

    def restart(self, state: InertialState, observation: Observation) -> InertialState:
        """Return a state at an observed position that keeps what is known of the sensor."""
        R = state.R
        P = state.P.copy()
        # Standard deviations after a restart.
        for part, sigma in ((POSITION, 0.02), (VELOCITY, 1.0)):
            P[part, :], P[:, part] = 0.0, 0.0
            P[part, part] = sigma**2 * _UNIT
        P[ATTITUDE, ATTITUDE] += math.radians(3.0) ** 2 * _UNIT
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

    def alignment(self, state: InertialState) -> Alignment:
        """Return the lever and mounting of a sensor that goes away; its yaw may be another afterwards."""
        covariance = np.zeros((6, 6))
        covariance[:3, :3], covariance[3:, 3:] = state.P[LEVER, LEVER], state.P[ACCELEROMETER, ACCELEROMETER]
        # A mounting known better than this, over all axes, serves a sensor that comes back.
        mounting_known = float(np.trace(state.P[MOUNTING, MOUNTING])) < math.radians(20.0) ** 2
        lever, bias, M = state.lever.copy(), state.acceleration_bias.copy(), state.M.copy()
        return Alignment(0.0, np.pi, lever, bias, covariance, np.zeros(6), M, mounting_known)

    def predict(self, state: InertialState, duration_s: float, step: InertialStep | None) -> InertialState:
        """Return the state after what the sensor measured; without a step it floats on evenly."""
        if step is None:
            still = state.R.T @ (-self._strapdown.gravity) + state.acceleration_bias
            step = InertialStep(duration_s, still, still, duration_s * state.rate_bias, dropout=True)
        return self._strapdown.predict(state, step)

    def nis(self, state: InertialState, observation: Observation) -> tuple[float, float]:
        """Return the squared normalised innovations of position and rotation."""
        H, residual, noise = self._linearised(state, observation)
        S = H @ state.P @ H.T + noise
        position = squared_distance(residual[:3], S[:3, :3])
        if observation.rotation is None:
            return position, 0.0
        return position, squared_distance(residual[3:], S[3:, 3:])

    def update(self, state: InertialState, observation: Observation) -> InertialState:
        """Return the state after an observation of its moment."""
        return correct(state, *self._linearised(state, observation))

    def zero_velocity_update(
        self, state: InertialState, speed_sigma: float, gate_nis: float | None, rolling: FloatArray | None = None
    ) -> InertialState:
        """Return the state after the sensor's velocity was measured; unchanged when its NIS is too high."""
        noise = speed_sigma**2 * _UNIT
        residual = -state.velocity
        if rolling is not None:
            residual = residual + np.cross(state.R @ rolling, self._C[:, 2])
        if gate_nis is not None and squared_distance(residual, state.P[VELOCITY, VELOCITY] + noise) > gate_nis:
            return state
        return correct(state, _H_VELOCITY, residual, noise)

    def zero_rate_update(self, state: InertialState, angular_rate: FloatArray, duration_s: float) -> InertialState:
        """Return the state after the sensor was measured not to rotate: its rate (3,), rad/s, is its bias."""
        residual = angular_rate - state.rate_bias
        # A sensor that measures more than this beyond its bias does rotate, however evenly.
        if residual @ residual > math.radians(1.0) ** 2:
            return state
        # Noise of the rate as a measure of its bias at rest, for one sample of 5 ms.
        noise = (math.radians(3.0) ** 2 * SAMPLE_S / duration_s) * _UNIT
        return correct(state, _H_RATE_BIAS, residual, noise)

    def motion(self, state: InertialState, angular_rate: FloatArray) -> FootMotion:
        """Return where the foot is."""
        arm = state.R @ state.lever
        H = np.zeros((3, SIZE))
        H[:, POSITION], H[:, ATTITUDE], H[:, LEVER] = _UNIT, -cross_matrix(arm), state.R
        rate = state.R @ (angular_rate - state.rate_bias)
        G = np.zeros((3, SIZE))
        G[:, ATTITUDE], G[:, MOUNTING] = _UNIT, state.R
        return FootMotion(
            state.position + arm,
            state.velocity + cross_matrix(rate) @ arm,
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


_H_VELOCITY: Final = np.zeros((3, SIZE))
_H_VELOCITY[:, VELOCITY] = _UNIT
_H_RATE_BIAS: Final = np.zeros((3, SIZE))
_H_RATE_BIAS[:, GYROSCOPE] = _UNIT
