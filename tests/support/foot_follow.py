"""A foot filter on a walking foot: what it said at the arrival of each picture, and by how much it was wrong."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from foot_walk import Walk, ns
from numpy.typing import NDArray

from rhot.geometry.rotations import (
    quaternion_from_rotation,
    rotation_between,
    rotation_from_quaternion,
    rotation_from_vector,
)
from rhot_bench.thesis.foot_filter import ThesisFilter
from rhot_feet.filter.foot_filter import FootFilter
from rhot_feet.filter.model import FootState
from rhot_feet.imu.conversion import FusedImuConverter

FloatArray = NDArray[np.float64]

LATE_S = 0.035
"""How late a picture is."""
SIGMA_M = 0.003
ROTATION_SIGMA = float(np.radians(2.0))


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
