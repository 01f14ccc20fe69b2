"""Strapdown inertial navigation of one foot, and what it may be wrong by: an error-state Kalman filter.

Nominal state: position p and velocity v of the *sensor* in the rig frame, its attitude R = R_rig_sensor, the biases of
accelerometer and gyroscope, and how the foot hangs on the sensor: lever l (the foot's origin in the sensor's frame) and
mounting M = R_sensor_foot. So the foot is at p + R·l with orientation R·M, and nothing has to be calibrated by hand:
the yaw of the sensor, the biases, the lever and the mounting are all states that the marker makes observable.

Errors (in this order, `POSITION` … `MOUNTING`) are additive, but for the rotations: R_true = exp(δθ)·R with δθ in the
rig frame, M_true = exp(δm)·M with δm in the sensor's frame. Over a step of h seconds, with a = R(f − b_a) + g,

    δp' = δp + h·δv,   δv' = δv − h·[R(f − b_a)]×·δθ − h·R·δb_a,   δθ' = δθ − h·R·δb_ω.

Source: Solà, "Quaternion kinematics for the error-state Kalman filter", arXiv:1711.02508, section 7 (global errors);
Foxlin, "Pedestrian tracking with shoe-mounted inertial sensors", IEEE Computer Graphics and Applications 25 (6), 2005,
for zero-velocity updates.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np

from rhot.arrays import FloatArray
from rhot.geometry.rotations import cross_matrix, orthonormal, rotation_from_vector
from rhot_feet.imu.track import InertialStep

POSITION: Final = slice(0, 3)
VELOCITY: Final = slice(3, 6)
ATTITUDE: Final = slice(6, 9)
ACCELEROMETER: Final = slice(9, 12)
GYROSCOPE: Final = slice(12, 15)
LEVER: Final = slice(15, 18)
MOUNTING: Final = slice(18, 21)
SIZE: Final = 21
_UNIT: Final = np.eye(3)
_UNITS: Final = np.eye(SIZE)


@dataclass(frozen=True, slots=True)
class InertialNoise:
    """How wrong an inertial sensor is; values chosen on the dev trials of PyShoe (`rhot evaluate steps`).

    Attributes:
        acceleration: white noise of the specific force, m/s²/√Hz.
        rate: white noise of the angular rate, rad/s/√Hz.
        jolt: share of the change of force between two samples that is white noise of the force on top, m/s²/√Hz per
            m/s²: between samples the force is not a straight line.
        scale: share of the rate that is white noise of the rate on top, rad/s/√Hz per rad/s: scale errors.
        acceleration_drift: random walk of the accelerometer's bias, m/s²/√s.
        rate_drift: random walk of the gyroscope's bias, rad/s/√s.
        alignment_drift: random walk of the mounting, rad/√s: straps slip.
        lever_drift: random walk of the lever, m/√s.
        dropout_acceleration_density: of what a foot does while samples are missing, m²/s³: 10 m/s² for 50 ms.
        dropout_rate_density: likewise, rad²/s: 3 rad/s for 50 ms.
    """

    acceleration: float = 0.05
    rate: float = 0.003
    jolt: float = 0.02
    scale: float = 0.002
    acceleration_drift: float = 1e-3
    rate_drift: float = 1e-5
    alignment_drift: float = 1e-3
    lever_drift: float = 2e-4
    dropout_acceleration_density: float = 10.0**2 * 0.05
    dropout_rate_density: float = 3.0**2 * 0.05


@dataclass(frozen=True, slots=True)
class InertialState:
    """A foot and its sensor at one moment; see the module for the frames.

    Attributes:
        position: (3,) of the sensor, metres, rig frame.
        velocity: (3,) of the sensor, m/s, rig frame.
        R: (3, 3) R_rig_sensor.
        acceleration_bias: (3,) m/s², sensor frame.
        rate_bias: (3,) rad/s, sensor frame.
        lever: (3,) the foot's origin, metres, sensor frame.
        M: (3, 3) R_sensor_foot.
        P: (21, 21) covariance of the errors.
    """

    position: FloatArray
    velocity: FloatArray
    R: FloatArray
    acceleration_bias: FloatArray
    rate_bias: FloatArray
    lever: FloatArray
    M: FloatArray
    P: FloatArray

    @property
    def foot_rotation(self) -> FloatArray:
        """R_rig_foot (3, 3)."""
        rotation: FloatArray = self.R @ self.M
        return rotation


class Strapdown:
    """Predicts and corrects `InertialState`s; stateless after construction."""

    def __init__(self, gravity: FloatArray, noise: InertialNoise) -> None:
        """Set the frame and the sensor.

        Args:
            gravity: (3,) acceleration of free fall, m/s², rig frame.
            noise: of the sensor.
        """
        self.gravity = gravity
        self._jolt, self._scale = noise.jolt**2, noise.scale**2
        self._noise = noise
        self._growth = np.zeros(SIZE)
        self._growth[VELOCITY] = noise.acceleration**2
        self._growth[ATTITUDE] = noise.rate**2
        self._growth[ACCELEROMETER] = noise.acceleration_drift**2
        self._growth[GYROSCOPE] = noise.rate_drift**2
        self._growth[LEVER] = noise.lever_drift**2
        self._growth[MOUNTING] = noise.alignment_drift**2

    def predict(self, state: InertialState, step: InertialStep) -> InertialState:
        """Return the state at the end of a step."""
        h = step.duration_s
        R = orthonormal(state.R @ rotation_from_vector(step.rotation_rad - h * state.rate_bias))
        force = 0.5 * (
            state.R @ (step.force_before - state.acceleration_bias) + R @ (step.force_after - state.acceleration_bias)
        )
        acceleration = force + self.gravity
        F = _UNITS.copy()
        F[POSITION, VELOCITY] = h * _UNIT
        F[VELOCITY, ATTITUDE] = -h * cross_matrix(force)
        F[POSITION, ATTITUDE] = (0.5 * h) * F[VELOCITY, ATTITUDE]
        F[VELOCITY, ACCELEROMETER] = F[ATTITUDE, GYROSCOPE] = -h * state.R
        P = F @ state.P @ F.T
        growth = h * self._growth
        jump = step.force_after - step.force_before
        growth[VELOCITY] += h * self._jolt * (jump @ jump)
        growth[ATTITUDE] += (self._scale / h) * (step.rotation_rad @ step.rotation_rad)
        if step.dropout:
            growth[VELOCITY] += h * self._noise.dropout_acceleration_density
            growth[ATTITUDE] += h * self._noise.dropout_rate_density
        P.reshape(-1)[:: SIZE + 1] += growth
        return InertialState(
            state.position + h * state.velocity + (0.5 * h * h) * acceleration,
            state.velocity + h * acceleration,
            R,
            state.acceleration_bias,
            state.rate_bias,
            state.lever,
            state.M,
            P,
        )


def correct(state: InertialState, H: FloatArray, residual: FloatArray, noise: FloatArray) -> InertialState:
    """Return the state after a measurement.

    Args:
        state: before it.
        H: (m, 21) derivative of the measurement by the errors.
        residual: (m,) measured minus expected.
        noise: (m, m) covariance of the measurement.
    """
    PHt = state.P @ H.T
    K = np.linalg.solve(H @ PHt + noise, PHt.T).T
    P = state.P - K @ PHt.T
    return inject(state, K @ residual, 0.5 * (P + P.T))


def inject(state: InertialState, dx: FloatArray, P: FloatArray) -> InertialState:
    """Return the state moved by errors (21,), with a new covariance (21, 21).

    Pictures show the foot's position p + R·l and rotation R·M, whatever the yaw of R. The covariance says so in terms
    of the old R and l; carried over unchanged, each correction of tilt or lever would seem to say something about the
    yaw. So the errors of the foot's position and rotation are kept (Barrau and Bonnabel, "The invariant extended
    Kalman filter as a stable observer", IEEE Transactions on Automatic Control 62 (4), 2017, choose errors for the same
    reason).
    """
    R, lever = orthonormal(rotation_from_vector(dx[ATTITUDE]) @ state.R), state.lever + dx[LEVER]
    kept = _UNITS.copy()
    kept[POSITION, ATTITUDE] = cross_matrix(R @ lever - state.R @ state.lever)
    kept[POSITION, LEVER] = state.R - R
    kept[MOUNTING, MOUNTING] = R.T @ state.R
    return InertialState(
        state.position + dx[POSITION],
        state.velocity + dx[VELOCITY],
        R,
        state.acceleration_bias + dx[ACCELEROMETER],
        state.rate_bias + dx[GYROSCOPE],
        lever,
        orthonormal(rotation_from_vector(dx[MOUNTING]) @ state.M),
        kept @ P @ kept.T,
    )
