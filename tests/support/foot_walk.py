"""A foot that walks in minimum-jerk steps, what marker and sensor say of it, and a filter that follows it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from rhot.arrays import FloatArray
from rhot.geometry.rotations import (
    quaternion_from_rotation,
    rotation_between,
    rotation_from_quaternion,
    rotation_from_vector,
    rotation_x,
    rotation_y,
    rotation_z,
)
from rhot_bench.thesis.feet import ThesisFilter
from rhot_feet.filter.foot_filter import FootFilter
from rhot_feet.filter.model import FootState
from rhot_feet.imu.samples import FusedImuConverter

START_NS = 1_700_000_000_000_000_000
UP = np.array([0.0, 1.0, 0.0])
C = np.array([[0.0, 1.0, 0.0], [0.0, 0.0, 1.0], [1.0, 0.0, 0.0]])
"""From level axes (z up) to the rig frame (y up)."""

LATE_S = 0.035
"""How late a picture is."""
SIGMA_M = 0.003
ROTATION_SIGMA = float(np.radians(2.0))


def ns(t: float) -> int:
    """Return a time of the walk on the rig clock."""
    return START_NS + round(t * 1e9)


@dataclass(frozen=True)
class Walk:
    """Steps of `stride_m` in `swing_s` with stands of `stance_s` between, along −z of the rig, y up.

    The sensor sits `lever` away (marker in the sensor's frame), turned by `R_sensor_foot`; its own level world lies
    `yaw_rad` from the rig's.
    """

    stride_m: float = 1.2
    height_m: float = 0.12
    swing_s: float = 0.5
    stance_s: float = 0.6
    pitch_rad: float = 0.7
    heading_rad: float = 0.4
    yaw_rad: float = 2.3
    lever: tuple[float, float, float] = (0.04, -0.06, 0.1)
    mounting: tuple[float, float, float] = (0.5, -0.8, 1.1)

    @property
    def R_sensor_foot(self) -> FloatArray:
        return rotation_from_vector(np.array(self.mounting))

    def foot(self, t: float) -> tuple[FloatArray, FloatArray]:
        """Position (3,) of the foot's origin and R_rig_foot at a time; the foot stands before 0."""
        period = self.swing_s + self.stance_s
        count, phase = divmod(max(t, 0.0), period)
        s = min(phase / self.swing_s, 1.0)
        done = s**3 * (10.0 - 15.0 * s + 6.0 * s**2)
        bump = 64.0 * (s * (1.0 - s)) ** 3
        heading = rotation_y(self.heading_rad * (1.0 if count % 2 else 0.6))
        way = sum(
            (
                rotation_y(self.heading_rad * (1.0 if k % 2 else 0.6)) @ [0.0, 0.0, -self.stride_m]
                for k in range(int(count))
            ),
            np.zeros(3),
        )
        place = np.array([0.1, 0.08, -0.3]) + way + done * (heading @ [0.0, 0.0, -self.stride_m])
        turn_before = self.heading_rad * (0.6 if count % 2 else 1.0) if count else self.heading_rad * 0.6
        turn_now = self.heading_rad * (1.0 if count % 2 else 0.6)
        yaw = turn_before + done * (turn_now - turn_before)
        pitch = -self.pitch_rad * bump * np.sin(2.0 * np.pi * s)
        return place + bump * self.height_m * UP, rotation_y(yaw) @ rotation_x(pitch)

    def sensor(self, t: float) -> tuple[FloatArray, FloatArray]:
        """Position (3,) of the sensor and R_rig_sensor."""
        place, R_foot = self.foot(t)
        R = R_foot @ self.R_sensor_foot.T
        return place - R @ np.array(self.lever), R

    def imu(
        self, t: FloatArray, seed: int, *, noise: float = 0.05, bias: float = 0.1, angle_rad: float = 5e-4
    ) -> tuple[FloatArray, FloatArray]:
        """Linear acceleration (N, 3) and quaternions (N, 4), as a BNO080 sends them."""
        random = np.random.default_rng(seed)
        d = 1e-3
        offset = random.normal(0.0, bias, 3)
        tilt = rotation_from_vector(np.append(random.normal(0.0, 0.015, 2), 0.0))
        accelerations, quaternions = np.empty((len(t), 3)), np.empty((len(t), 4))
        for k, now in enumerate(t):
            (before, _), (place, R), (after, _) = self.sensor(now - d), self.sensor(now), self.sensor(now + d)
            a = (before - 2.0 * place + after) / d**2
            force = R.T @ (a + 9.81 * UP) + offset + random.normal(0.0, noise, 3)
            world = rotation_z(-self.yaw_rad) @ C.T @ R
            world = rotation_from_vector(random.normal(0.0, angle_rad, 3)) @ tilt @ world
            quaternions[k] = quaternion_from_rotation(world)
            accelerations[k] = force - 9.81 * world[2]
        return accelerations, quaternions


@dataclass(frozen=True)
class Track:
    """What a filter said at the arrival of each picture, and by how much it was wrong."""

    t: FloatArray
    error_m: FloatArray
    turn_deg: FloatArray
    states: list[FootState]

    def after(self, t: float) -> FloatArray:
        return self.error_m[self.t > t]

    def stages(self, stage: str) -> NDArray[np.bool_]:
        return np.array([state.stage == stage for state in self.states])


@lru_cache(maxsize=8)
def sensed(walk: Walk, seed: int) -> tuple[FloatArray, FloatArray]:
    """What the sensor sends from a second before the walk on."""
    return walk.imu(np.arange(-1.0, 9.0, 0.01), seed)


def follow(
    walk: Walk,
    seconds: float,
    foot: FootFilter | ThesisFilter,
    *,
    sensor: Callable[[float], bool] = lambda _t: True,
    seen: Callable[[float], bool] = lambda _t: True,
    false_share: float = 0.0,
    late_s: float = LATE_S,
    seed: int = 0,
    turn_yaw_rad: Callable[[float], float] = lambda _t: 0.0,
) -> Track:
    """Run a filter on 100 samples and 60 pictures a second; the foot stands for a second before it walks."""
    random = np.random.default_rng(seed)
    t_imu, t_picture = np.arange(-1.0, seconds, 0.01), np.arange(-0.997, seconds - late_s - 0.01, 1.0 / 60.0)
    acceleration, quaternions = sensed(walk, seed)
    converter = FusedImuConverter()
    events = sorted([(t, 0, k) for k, t in enumerate(t_imu)] + [(t + late_s, 1, k) for k, t in enumerate(t_picture)])
    times, errors, turns, states = [], [], [], []
    for now, is_picture, k in events:
        if not is_picture:
            if sensor(now):
                yaw = turn_yaw_rad(now)
                spin = np.array([0.0, 0.0, np.sin(yaw / 2.0), np.cos(yaw / 2.0)])
                world = rotation_from_quaternion(spin) @ rotation_from_quaternion(quaternions[k])
                q = quaternion_from_rotation(world)
                foot.add_imu_samples(converter.convert(np.array([ns(now)]), acceleration[k : k + 1], q[None]))
            continue
        t = float(t_picture[k])
        if seen(t):
            position, R = walk.foot(t)
            position = position + random.normal(0.0, SIGMA_M, 3)
            if random.random() < false_share:
                position = position + random.normal(0.0, 1.0, 3)
            turned = rotation_from_vector(random.normal(0.0, ROTATION_SIGMA, 3)) @ R
            foot.update_marker(
                ns(t), position, SIGMA_M**2 * np.eye(3), quaternion_from_rotation(turned), ROTATION_SIGMA**2 * np.eye(3)
            )
        state = foot.state(ns(now))
        if state is not None:
            position, R = walk.foot(now)
            times.append(now)
            errors.append(float(np.linalg.norm(state.position - position)))
            turn = rotation_between(rotation_from_quaternion(state.orientation_xyzw), R)
            turns.append(float(np.degrees(np.linalg.norm(turn))))
            states.append(state)
    return Track(np.array(times), np.array(errors), np.array(turns), states)
