"""Inertial sensors on the ankles, with the faults of a BNO080.

The sensor sits on the shoe beside the ankle, rotated as it happens to be strapped on. It reports, at 100 Hz as text or
400 Hz as binary records, its orientation in a frame of its own with z up (east, north, up, but north is where it thinks
it is), linear acceleration with gravity taken away by that orientation, and the angular rate:

    R_reported = R_north_rig · E · R_rig_sensor,
    a_reported = R_rig_sensorᵀ · (a + e × g) + bias + noise,   g = 9.81 m/s² along +y,

where the tilt error e grows with the motion of the last second and fades when the foot rests: at rest a BNO080 finds
down by its accelerometer, so that what is left of gravity is small. The amounts are set so that the figures of the
BNO080 datasheet (2017, fig. 6-12: rotation off by 2.5 degrees and linear acceleration by 0.35 m/s² in motion, heading
drift 0.5 degrees a minute) come out about, and the noise at rest as in real recordings of foot-mounted sensors
(0.02 m/s²). Values are rounded to the Q points that Sparkfun's library for the BNO080 reads (8, 14 and 9 bits).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache
from typing import Final, Self

import numpy as np
from numpy.typing import NDArray

from rhot.arrays import FloatArray
from rhot.geometry.rotations import (
    cross_matrix,
    nearest_rotation,
    quaternion_from_rotation,
    rigid,
    rotation_vectors,
)
from rhot.messages import Side
from rhot_feet.imu.samples import GRAVITY_M_S2
from rhot_sim.walker.foot_path import OUTWARDS, SIDES, PlannedStep
from rhot_sim.world.motion import evaluate_spline
from rhot_sim.world.script import seeded

Poses = Callable[[FloatArray], FloatArray]

ACCELERATION_STEP: Final = 2.0**-8
QUATERNION_STEP: Final = 2.0**-14
RATE_STEP: Final = 2.0**-9
FULL_SCALE_M_S2: Final = 8.0 * GRAVITY_M_S2
R_UP_RIG: FloatArray = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]])
"""From the rig's axes (y up) to axes with z up."""
R_UP_RIG.setflags(write=False)

_STREAM: Final = 42
_CHUNK: Final = 256
_MEMORY_S: Final = 0.25 * np.arange(1, 7)
_RINGING_S: Final = 0.012
_GAP_SLOT_S: Final = 10.0
_NOISES: Final = 10


@dataclass(frozen=True, slots=True)
class ImuErrors:
    """How bad the sensor is; all values are standard deviations unless they say otherwise.

    Attributes:
        acceleration_m_s2: white noise of a sample.
        bias_m_s2: of the constant part of the acceleration's bias, and a third of that wanders within half a minute.
        tilt_rad: of the reported orientation about level axes at rest.
        tilt_in_motion_rad: of the tilt error for each metre per second of the foot's mean speed in the last second.
        heading_rad: of the wandering of the heading.
        heading_drift_rad_s: largest steady drift of the heading.
        rate_rad_s: white noise of a sample of the angular rate.
        rate_bias_rad_s: of the constant bias of the angular rate.
        impact: share of the ringing of shoe and strap after each heel strike.
        clock_s: of a sample's time stamp.
        loss: share of samples that are lost alone.
        gap_rate: share of stretches of ten seconds in which 50 to 200 ms are lost.
        quantised: values are rounded as the sensor does.
    """

    acceleration_m_s2: float = 0.025
    bias_m_s2: float = 0.03
    tilt_rad: float = float(np.radians(0.8))
    tilt_in_motion_rad: float = float(np.radians(1.2))
    heading_rad: float = float(np.radians(1.0))
    heading_drift_rad_s: float = float(np.radians(0.5) / 60.0)
    rate_rad_s: float = 0.003
    rate_bias_rad_s: float = 0.004
    impact: float = 1.0
    clock_s: float = 0.0002
    loss: float = 0.003
    gap_rate: float = 0.3
    quantised: bool = True

    @classmethod
    def none(cls) -> Self:
        """Return a perfect sensor."""
        return cls(
            acceleration_m_s2=0.0,
            bias_m_s2=0.0,
            tilt_rad=0.0,
            tilt_in_motion_rad=0.0,
            heading_rad=0.0,
            heading_drift_rad_s=0.0,
            rate_rad_s=0.0,
            rate_bias_rad_s=0.0,
            impact=0.0,
            clock_s=0.0,
            loss=0.0,
            gap_rate=0.0,
            quantised=False,
        )


class AnkleImu:
    """One sensor; the same question always gets the same answer.

    Args:
        seed: of the world.
        side: whose ankle.
        ankles: gives T_rig_ankle (N, 4, 4) at times (N,).
        steps: of this foot, whose heel strikes shake the sensor.
        period_s: after which the steps come again.
        rate_hz: samples per second.
        errors: of the sensor.
    """

    def __init__(
        self,
        seed: int,
        side: Side,
        ankles: Poses,
        steps: tuple[PlannedStep, ...],
        period_s: float,
        rate_hz: float,
        errors: ImuErrors | None = None,
    ) -> None:
        self._key = (seed, _STREAM, SIDES.index(side))
        self._ankles = ankles
        self._period_s = period_s
        self._rate_hz = rate_hz
        self._errors = errors or ImuErrors()
        self._strikes = np.array([[step.strike_s, 6.0 + 40.0 * step.strike_rad] for step in steps]).reshape(-1, 2)
        rng = seeded(*self._key)
        self._phase_s = rng.uniform(0.0, 1.0 / rate_hz)
        position = np.array([OUTWARDS[side] * 0.045, 0.03, 0.0]) + rng.normal(0.0, 0.008, 3)
        self.T_ankle_sensor = rigid(nearest_rotation(rng.normal(0.0, 1.0, (3, 3))), position)
        """How the sensor is strapped on, (4, 4); a tracker does not know it."""
        self._north_rad = rng.uniform(0.0, 2.0 * np.pi)
        self._drift_rad_s = rng.uniform(-1.0, 1.0) * self._errors.heading_drift_rad_s
        self._bias = rng.normal(0.0, 1.0, 3) * self._errors.bias_m_s2
        self._rate_bias = rng.normal(0.0, 1.0, 3) * self._errors.rate_bias_rad_s
        self._noise = lru_cache(maxsize=64)(self._drawn)
        self._knots = {
            name: lru_cache(maxsize=256)(self._knot_drawer(number))
            for number, name in enumerate(("bias", "tilt", "moving", "heading"))
        }

    def samples(self, t0_s: float, t1_s: float) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
        """Return what the sensor measures from `t0_s` to before `t1_s`, lost samples left out.

        Returns:
            Time stamps (N,), seconds; linear acceleration (N, 3), m/s², sensor frame; orientation of the sensor in its
            own frame with z up (N, 4), quaternion x, y, z, w; angular rate (N, 3), rad/s, sensor frame.
        """
        first, last = (int(np.ceil((t - self._phase_s) * self._rate_hz - 1e-9)) for t in (t0_s, t1_s))
        number = np.arange(max(first, 0), max(last, 0))
        number = number[~self._lost(number)]
        if not len(number):
            return np.empty(0), np.empty((0, 3)), np.empty((0, 4)), np.empty((0, 3))
        t = self._phase_s + number / self._rate_hz
        noise = self._noise_of(number)
        acceleration, R, rate = self._motion(t)
        tilt = self._tilt_in_motion(t)
        acceleration += self._ringing(t) + GRAVITY_M_S2 * np.cross(tilt, [0.0, 1.0, 0.0])
        errors = self._errors
        linear = np.einsum("nji,nj->ni", R, acceleration) + self._bias
        linear += errors.bias_m_s2 / 3.0 * self._wander("bias", t, 10.0) + errors.acceleration_m_s2 * noise[:, :3]
        linear = np.clip(linear, -FULL_SCALE_M_S2, FULL_SCALE_M_S2)
        rate += self._rate_bias + errors.rate_rad_s * noise[:, 3:6]
        quaternion = quaternion_from_rotation(self._reported(t, R, tilt))
        if errors.quantised:
            linear = np.round(linear / ACCELERATION_STEP) * ACCELERATION_STEP
            quaternion = np.round(quaternion / QUATERNION_STEP) * QUATERNION_STEP
            rate = np.round(rate / RATE_STEP) * RATE_STEP
        return t + errors.clock_s * noise[:, 6].clip(-3.0, 3.0), linear, quaternion, rate

    def delivered_s(self, t_s: FloatArray) -> FloatArray:
        """Return when samples with these time stamps (N,) come out of the serial port: 4 ms later and more."""
        number = np.maximum(np.rint((t_s - self._phase_s) * self._rate_hz).astype(np.int64), 0)
        delivered: FloatArray = t_s + 0.004 + 0.002 * np.abs(self._noise_of(number)[:, 7])
        return delivered

    def _motion(self, t: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Return acceleration (N, 3), rig frame, rotation R_rig_sensor (N, 3, 3) and angular rate (N, 3), sensor frame.

        Differences over a sample's length, as a sensor's own low-pass filter leaves them.
        """
        half = 0.5 / self._rate_hz
        before, now, after = (self._ankles(t + shift) @ self.T_ankle_sensor for shift in (-half, 0.0, half))
        acceleration = (after[:, :3, 3] - 2.0 * now[:, :3, 3] + before[:, :3, 3]) / half**2
        rotation = np.swapaxes(before[:, :3, :3], 1, 2) @ after[:, :3, :3]
        return acceleration, now[:, :3, :3], rotation_vectors(rotation) / (2.0 * half)

    def _tilt_in_motion(self, t: FloatArray) -> FloatArray:
        """Return the tilt error (N, 3), radians, about the rig's axes; none about the vertical."""
        places = np.stack([self._ankles(t - lag)[:, :3, 3] for lag in (0.0, *_MEMORY_S)])
        path = np.linalg.norm(np.diff(places, axis=0), axis=2)
        weights = np.exp(-_MEMORY_S / 1.0)
        speed = weights @ path / (weights.sum() * 0.25)
        tilt = self._errors.tilt_in_motion_rad * speed[:, None] * self._wander("moving", t, 0.5)
        level: FloatArray = tilt * [1.0, 0.0, 1.0]
        return level

    def _reported(self, t: FloatArray, R: FloatArray, tilt: FloatArray) -> FloatArray:
        """Return the rotation (N, 3, 3) that the sensor reports."""
        off = tilt + self._errors.tilt_rad * self._wander("tilt", t, 5.0) * [1.0, 0.0, 1.0]
        heading = self._north_rad + self._drift_rad_s * t
        heading = heading + self._errors.heading_rad * self._wander("heading", t, 10.0)[:, 0]
        c, s = np.cos(heading), np.sin(heading)
        yaw = np.zeros((len(t), 3, 3))
        yaw[:, 0, 0], yaw[:, 0, 1], yaw[:, 1, 0], yaw[:, 1, 1], yaw[:, 2, 2] = c, -s, s, c, 1.0
        reported: FloatArray = yaw @ R_UP_RIG @ (np.eye(3) + cross_matrix(off)) @ R
        return reported

    def _ringing(self, t: FloatArray) -> FloatArray:
        """Return the acceleration (N, 3), rig frame, with which shoe and strap ring after heel strikes.

        A damped cosine whose phase leaves no velocity behind: ∫ exp(−t/τ) · cos(ωt + φ) dt = 0 for tan φ = 1/(ωτ).
        """
        shaken = np.zeros((len(t), 3))
        if not len(self._strikes):
            return shaken
        since = np.mod(t[:, None] - self._strikes[:, 0], self._period_s)
        ringing_hz = 35.0
        omega = 2.0 * np.pi * ringing_hz
        wave = np.exp(-since / _RINGING_S) * np.cos(omega * since + np.arctan(1.0 / (omega * _RINGING_S)))
        shaken[:, 1] = self._errors.impact * (wave @ self._strikes[:, 1])
        return shaken

    def _wander(self, name: str, t: FloatArray, knot_s: float) -> FloatArray:
        """Return a smooth random curve (N, 3) of about unit variance."""
        # A cubic B-spline of independent unit controls has a variance of about 0.48.
        curve: FloatArray = evaluate_spline(t, knot_s, self._knots[name]) / np.sqrt(0.48)
        return curve

    def _knot_drawer(self, number: int) -> Callable[[int], FloatArray]:
        def draw(knot: int) -> FloatArray:
            return seeded(*self._key, 1, number, knot + 8).normal(0.0, 1.0, 3)

        return draw

    def _drawn(self, chunk: int) -> FloatArray:
        return seeded(*self._key, 2, chunk).normal(0.0, 1.0, (_CHUNK, _NOISES))

    def _noise_of(self, number: NDArray[np.int64]) -> FloatArray:
        """Return the noise (N, 10), of unit variance, that belongs to samples by their numbers."""
        chunks = number // _CHUNK
        table = {int(chunk): self._noise(int(chunk)) for chunk in np.unique(chunks)}
        first = min(table)
        stacked = np.stack([table.get(chunk, np.empty((_CHUNK, _NOISES))) for chunk in range(first, max(table) + 1)])
        noise: FloatArray = stacked[chunks - first, number % _CHUNK]
        return noise

    def _lost(self, number: NDArray[np.int64]) -> NDArray[np.bool_]:
        """Tell (N,) which samples nobody ever sees."""
        if not len(number):
            return np.zeros(0, dtype=bool)
        # The tail of a normal variable beyond which `loss` of it lies, from the logistic approximation of its integral.
        loss = self._errors.loss
        alone = self._noise_of(number)[:, 8] > (np.log((1.0 - loss) / loss) / 1.702 if loss > 0.0 else np.inf)
        t = self._phase_s + number / self._rate_hz
        slot, into_s = np.divmod(t, _GAP_SLOT_S)
        for each in np.unique(slot):
            rng = seeded(*self._key, 3, int(each))
            if rng.random() < self._errors.gap_rate:
                start_s, length_s = rng.uniform(0.0, _GAP_SLOT_S - 0.2), rng.uniform(0.05, 0.2)
                alone |= (slot == each) & (into_s >= start_s) & (into_s < start_s + length_s)
        return alone
