"""Inputs and outputs of the filters of one foot, and the interface between filter models and their history."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Literal, Protocol, TypeVar

import numpy as np

from rhot.arrays import FloatArray
from rhot.geometry.covariances import squared_distance
from rhot_feet.filter.strapdown import InertialNoise
from rhot_feet.imu.track import InertialStep
from rhot_feet.imu.zero_velocity_detector import ZeroVelocitySettings

Stage = Literal["marker", "depth", "inertial", "lost"]


@dataclass(frozen=True, slots=True)
class FootFilterSettings:
    """How one foot is filtered; values without another source were chosen on `rhot evaluate feet`.

    Attributes:
        up: (3,) direction against gravity, rig frame, of any length.
        sensor_m: (3,) about where the inertial sensor is worn, metres, foot frame.
        noise: of the inertial sensor.
        zero_velocity: of the zero-velocity detector.
        horizon_ns: how late a measurement may be.
        gate_nis: squared normalised innovation (NIS, 3 degrees of freedom) up to which an observation is accepted: 5
            standard deviations.
        agreeing: number of consecutive rejected observations that agree with each other and restart the filter.
        fresh_ns: time after an observation for which its stage is reported.
        position_floor_m, rotation_floor_rad: added to every observation's noise, per axis.
        marker_rotation_rad: noise of a marker's orientation, per axis, if the caller gives none.
        depth_correlation_s: correlation time of the errors of depth positions.
        moving_yaw_rad: a sensor with a larger yaw uncertainty is not used for a foot that swings in sight.
        return_yaw_rad: yaw error of a reconnected sensor, taken from one orientation of the marker.
        restarts, restarts_ns: number of restarts within this time that discards the alignment.
    """

    up: tuple[float, float, float] = (0.0, 1.0, 0.0)
    sensor_m: tuple[float, float, float] = (0.0, 0.0, 0.07)
    noise: InertialNoise = field(default_factory=InertialNoise)
    zero_velocity: ZeroVelocitySettings = field(default_factory=ZeroVelocitySettings)
    horizon_ns: int = 250_000_000
    gate_nis: float = 25.0
    agreeing: int = 8
    fresh_ns: int = 100_000_000
    position_floor_m: float = 0.001
    rotation_floor_rad: float = math.radians(1.0)
    marker_rotation_rad: float = math.radians(3.0)
    depth_correlation_s: float = 0.05
    moving_yaw_rad: float = math.radians(9.0)
    return_yaw_rad: float = math.radians(8.0)
    restarts: int = 3
    restarts_ns: int = 3_000_000_000


@dataclass(frozen=True, slots=True)
class FootState:
    """The state of a foot at one time.

    Attributes:
        t_ns: the time, rig clock.
        position: (3,) of the foot's origin, metres, rig frame.
        velocity: (3,) m/s, rig frame.
        orientation_xyzw: (4,) foot to rig.
        covariance: (3, 3) of the position, m².
        orientation_covariance: (3, 3) of the orientation's error as a rotation vector in the rig frame, rad².
        stage: best recent measurement.
        stationary: whether the foot stands.
        measured_ns: when it was last seen, or until when it has stood since, rig clock.
        set_off_m: standard deviation of its motion since, if it has started to move, over all axes; 0 with a sensor.
        followed: whether a sensor, aligned or not, has measured its motion since.
    """

    t_ns: int
    position: FloatArray
    velocity: FloatArray
    orientation_xyzw: FloatArray
    covariance: FloatArray
    orientation_covariance: FloatArray
    stage: Stage
    stationary: bool
    measured_ns: int
    set_off_m: float = 0.0
    followed: bool = False

    @property
    def sigma_m(self) -> float:
        """Root of the sum of the three variances of the position and of `set_off_m` squared, metres."""
        return math.sqrt(max(float(np.trace(self.covariance)), 0.0) + self.set_off_m**2)


@dataclass(frozen=True, slots=True)
class Observation:
    """An observation of the foot's origin in one image.

    Attributes:
        t_ns: middle of the exposure, rig clock.
        position: (3,) metres, rig frame.
        covariance: (3, 3) of the position, m².
        rotation: R_rig_foot (3, 3), if it was seen.
        rotation_covariance: (3, 3) of its error as a rotation vector in the rig frame, rad².
        stage: where it comes from.
    """

    t_ns: int
    position: FloatArray
    covariance: FloatArray
    rotation: FloatArray | None
    rotation_covariance: FloatArray
    stage: Literal["marker", "depth"]


@dataclass(frozen=True, slots=True)
class FootMotion:
    """The motion of a foot at one time, for all filter models.

    Attributes:
        position: (3,) of the foot's origin, metres, rig frame.
        velocity: (3,) m/s, rig frame.
        rotation: R_rig_foot (3, 3).
        covariance: (3, 3) of the position, m².
        rotation_covariance: (3, 3) of the orientation's error as a rotation vector in the rig frame, rad².
    """

    position: FloatArray
    velocity: FloatArray
    rotation: FloatArray
    covariance: FloatArray
    rotation_covariance: FloatArray

    def nis(self, observation: Observation) -> float:
        """Return the squared normalised innovation of an observed position; 3 degrees of freedom."""
        return squared_distance(observation.position - self.position, self.covariance + observation.covariance)


@dataclass(slots=True)
class FilterCounts:
    """Counts of observations.

    Attributes:
        accepted: observations that updated the filter.
        gated: rejected by the outlier gate.
        late: older than the horizon.
        restarts: restarts of the filter at an observed position.
    """

    accepted: int = 0
    gated: int = 0
    late: int = 0
    restarts: int = 0


State = TypeVar("State")


class FootModel(Protocol[State]):
    """One kind of filter: pure functions of its states."""

    def predict(self, state: State, duration_s: float, step: InertialStep | None) -> State:
        """Return the state `duration_s` later; `step` is what the sensor, if there is one, measured meanwhile."""
        ...

    def nis(self, state: State, observation: Observation) -> tuple[float, float]:
        """Return the squared normalised innovations of position and rotation (0 without); 3 degrees of freedom each."""
        ...

    def update(self, state: State, observation: Observation) -> State:
        """Return the state after an observation of its moment."""
        ...

    def zero_velocity_update(
        self, state: State, speed_sigma: float, gate_nis: float | None, rolling: FloatArray | None = None
    ) -> State:
        """Return the state after the sensor's velocity was measured to be zero, or that of a foot that rolls.

        Args:
            state: before it.
            speed_sigma: of the velocity about zero, m/s.
            gate_nis: squared normalised innovation above which it is refused; None never refuses.
            rolling: (3,) m/s, sensor frame: angular rate times how far below the sensor the foot touches the floor.
        """
        ...

    def zero_rate_update(self, state: State, angular_rate: FloatArray, duration_s: float) -> State:
        """Return the state after a sensor that does not rotate measured a rate (3,) rad/s over `duration_s`."""
        ...

    def motion(self, state: State, angular_rate: FloatArray) -> FootMotion:
        """Return where the foot is; `angular_rate` (3,) rad/s is what the sensor, if there is one, measures."""
        ...
