"""A whole recording of one foot by its inertial sensor alone, and how far it is from the truth."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Final

import numpy as np

from rhot.arrays import BoolArray, FloatArray
from rhot.geometry.rotations import rotation_from_quaternion
from rhot_feet.filter.inertial import InertialModel
from rhot_feet.filter.strapdown import (
    ACCELEROMETER,
    ATTITUDE,
    GYROSCOPE,
    POSITION,
    SIZE,
    VELOCITY,
    InertialNoise,
    InertialState,
    Strapdown,
)
from rhot_feet.filter.zero_velocity_update import zero_velocity_update
from rhot_feet.imu.conversion import level_rotation
from rhot_feet.imu.samples import GRAVITY_M_S2, ImuSamples
from rhot_feet.imu.track import InertialStep
from rhot_feet.imu.zero_velocity_detector import MOVING, ZeroVelocity, ZeroVelocityDetector, ZeroVelocitySettings

_VERDICTS: Final = {False: MOVING, True: ZeroVelocity(still=True, speed_sigma=0.01, rate=None)}
_STRAIGHT_M: Final = 0.8
"""Distance from the start at which headings are made equal, as the published figures do."""


def reckon(
    samples: ImuSamples,
    noise: InertialNoise | None = None,
    detector: ZeroVelocitySettings | None = None,
    still: BoolArray | None = None,
) -> FloatArray:
    """Return the positions (N, 3), metres, z up, of a sensor that stands at the origin at first.

    It is the filter and the detector that run live, forwards and without any other measurement.

    Args:
        samples: of the whole recording.
        noise: of the sensor.
        detector: its settings.
        still: (N,) verdict of another detector, to be used instead.
    """
    gravity = np.array([0.0, 0.0, -GRAVITY_M_S2])
    model = InertialModel(Strapdown(gravity, noise or InertialNoise()), np.eye(3))
    zero_velocity = ZeroVelocityDetector(detector)
    state = _at_rest(samples)
    positions = np.zeros((len(samples), 3))
    for k in range(1, len(samples)):
        h = float(samples.t_ns[k] - samples.t_ns[k - 1]) * 1e-9
        force, rate = samples.specific_force[k], samples.angular_rate[k]
        measured = zero_velocity.add(h, force, rate) if still is None else _VERDICTS[bool(still[k])]
        state = model.predict(state, h, InertialStep(h, samples.specific_force[k - 1], force, h * rate))
        state = zero_velocity_update(model, state, measured, rate, h, gated=False)
        positions[k] = state.position
    return positions


def faster(samples: ImuSamples, times: float) -> ImuSamples:
    """Return what a sensor would have measured had the foot gone the same way `times` as fast.

    Rotation rates are that much larger, accelerations by its square; gravity g is what it is. With the orientation R to
    a level world that came with the samples,

        ω' = s·ω        f' = s²·f − (s² − 1)·Rᵀ·g

    so that an error of R is an error of f', which is why this is no substitute for somebody who runs.
    """
    R = rotation_from_quaternion(samples.orientation_xyzw)
    force = times**2 * samples.specific_force - (times**2 - 1.0) * GRAVITY_M_S2 * R[:, 2, :]
    t_ns = samples.t_ns[0] + np.round((samples.t_ns - samples.t_ns[0]) / times).astype(np.int64)
    return replace(samples, t_ns=t_ns, specific_force=force, angular_rate=times * samples.angular_rate)


def _at_rest(samples: ImuSamples) -> InertialState:
    P = np.zeros((SIZE, SIZE))
    for part, sigma in (
        (POSITION, 1e-5),
        (VELOCITY, 1e-3),
        (ATTITUDE, math.radians(0.5)),
        (ACCELEROMETER, 0.1),
        (GYROSCOPE, math.radians(0.2)),
    ):
        P[part, part] = sigma**2 * np.eye(3)
    # The heading is not measured by anything: it is what it is.
    P[ATTITUDE.stop - 1, ATTITUDE.stop - 1] = 1e-8
    zero = np.zeros(3)
    # Samples at the start in which the foot stands, for the direction of up.
    R = level_rotation(samples.specific_force[:20].mean(axis=0))
    return InertialState(zero, zero, R, zero, zero, zero, np.eye(3), P)


def horizontal_error_m(positions: FloatArray, truth: FloatArray) -> float:
    """Return the error of a path (N, 3) as the data set's authors measure it ("ARMSE, 2D"), metres.

    Both paths begin at the origin and are rotated into one heading where the first is 0.8 m away; then the mean over
    time of √((Δx² + Δy²)/2).
    """
    path, true = positions - positions[0], truth - truth[0]
    away = np.hypot(path[:, 0], path[:, 1])
    at = int(np.argmax(away >= _STRAIGHT_M)) if away.max() >= _STRAIGHT_M else len(path) - 1
    heading = math.atan2(true[at, 1], true[at, 0]) - math.atan2(path[at, 1], path[at, 0])
    c, s = math.cos(heading), math.sin(heading)
    level = path[:, :2] @ np.array([[c, s], [-s, c]])
    return float(np.sqrt(((level - true[:, :2]) ** 2).mean(axis=1)).mean())
