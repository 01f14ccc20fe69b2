"""Steps from stand-still to stand-still: what the sensor felt of them, and when they are not to be trusted."""

from __future__ import annotations

import numpy as np
import pytest
from foot_walk import C, Walk, ns
from numpy.typing import NDArray

from rhot.geometry.rotations import rotation_from_quaternion, rotation_z
from rhot_feet.imu.alignment.estimator import FootStep, StepTracker

WALK = Walk()
TIMES = np.arange(-0.5, 0.9, 0.01)
ACCELERATION, QUATERNIONS = WALK.imu(TIMES, 1, bias=0.05)


def walk(*, missing: tuple[float, float] = (9.0, 9.0), seen_again: bool = True) -> FootStep | None:
    """One step of half a second, seen only while the foot stands."""
    watcher, step = StepTracker(), None
    rotations = rotation_from_quaternion(QUATERNIONS)
    for t, acceleration, R in zip(TIMES.tolist(), ACCELERATION, rotations, strict=True):
        stands = not -0.02 < t < 0.55
        if not missing[0] < t < missing[1]:
            watcher.add_sample(ns(t), acceleration + 9.81 * R[2], R, stands=stands)
        if stands and (t < 0.0 or seen_again):
            step = watcher.add_marker(ns(t), C.T @ WALK.foot(t)[0]) or step
    return step


def test_a_step_is_felt_as_it_is_seen() -> None:
    step = walk()
    assert step is not None
    # The marker's way is the sensor's, turned into the rig's axes, and what the lever does.
    R = rotation_z(WALK.yaw_rad)
    way: NDArray[np.float64] = R @ (step.imu_m + step.rotation_change @ np.array(WALK.lever))
    assert np.linalg.norm(step.marker_m) == pytest.approx(1.2, abs=0.005)
    assert 1e3 * np.linalg.norm(way - step.marker_m) < 40.0


def test_a_step_is_nothing_before_its_end_is_seen_or_with_samples_missing() -> None:
    assert walk(seen_again=False) is None
    assert walk(missing=(0.2, 0.3)) is None
