"""What a filter of one foot takes in and gives out, and the seam between its kinds and the history they run in."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Literal, Protocol, TypeVar

import numpy as np
from numpy.typing import NDArray

from rhot_feet.imu.strapdown import InertialNoise, InertialStep
from rhot_feet.imu.zero_velocity import StillnessSettings

FloatArray = NDArray[np.float64]

Stage = Literal["marker", "depth", "inertial", "lost"]


@dataclass(frozen=True, slots=True)
class FootFilterSettings:
    """How one foot is filtered.

    Attributes:
        up: (3,) direction against gravity, rig frame, of any length.
        sensor_m: (3,) about where the inertial sensor is worn, metres, foot frame.
        noise: of the inertial sensor.
        stillness: of the detector of stand-stills.
        horizon_ns: how late a measurement may be.
        gate: squared normalised innovation up to which an observation is believed (3 degrees of freedom).
        agreeing: so many observations in a row that were turned away and agree start the filter anew.
        fresh_ns: so long after an observation its stage holds.
    """

    up: tuple[float, float, float] = (0.0, 1.0, 0.0)
    sensor_m: tuple[float, float, float] = (0.0, 0.0, 0.07)
    noise: InertialNoise = field(default_factory=InertialNoise)
    stillness: StillnessSettings = field(default_factory=StillnessSettings)
    horizon_ns: int = 250_000_000
    gate: float = 25.0
    agreeing: int = 8
    fresh_ns: int = 100_000_000


@dataclass(frozen=True, slots=True)
class FootState:
    """Where a foot is at one moment.

    Attributes:
        t_ns: the moment, rig clock.
        position: (3,) of the foot's origin, metres, rig frame.
        velocity: (3,) m/s, rig frame.
        orientation_xyzw: (4,) foot to rig.
        covariance: (3, 3) of the position, m².
        orientation_covariance: (3, 3) of the orientation's error as a rotation vector in the rig frame, rad².
        stage: the best evidence of the last moment.
        stationary: the foot stands.
        measured_ns: when it was last seen, or last felt to have stood ever since.
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

    @property
    def sigma_m(self) -> float:
        """Root of the sum of the three variances of the position, metres."""
        return math.sqrt(max(float(np.trace(self.covariance)), 0.0))


@dataclass(frozen=True, slots=True)
class Observation:
    """A place of the foot's origin out of a picture.

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
    """A foot at one moment, whatever the filter.

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


State = TypeVar("State")


class FootModel(Protocol[State]):
    """One kind of filter: pure functions of its states."""

    def predict(self, state: State, duration_s: float, step: InertialStep | None) -> State:
        """Return the state `duration_s` later, in which the sensor, if there is one, felt `step`."""
        ...

    def surprise(self, state: State, observation: Observation) -> tuple[float, float]:
        """Return the squared normalised innovations of position and rotation (0 without); 3 degrees of freedom each."""
        ...

    def observe(self, state: State, observation: Observation) -> State:
        """Return the state after an observation of its moment."""
        ...

    def rest(self, state: State, speed_sigma: float, gate: float | None) -> State:
        """Return the state after the foot was felt to stand.

        Args:
            state: before it.
            speed_sigma: of the velocity about zero, m/s.
            gate: squared normalised innovation above which it is not believed; None always believes.
        """
        ...

    def rest_turning(self, state: State, angular_rate: FloatArray, duration_s: float) -> State:
        """Return the state after the sensor was felt not to turn at all over `duration_s`."""
        ...

    def motion(self, state: State, angular_rate: FloatArray) -> FootMotion:
        """Return where the foot is; `angular_rate` (3,) rad/s is what the sensor, if there is one, feels."""
        ...
