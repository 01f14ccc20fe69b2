from __future__ import annotations

import numpy as np
import pytest
from foot_walk import Walk, ns

from rhot.geometry.rotations import (
    quaternion_from_rotation,
    rotation_between,
    rotation_from_quaternion,
    rotation_from_vector,
)
from rhot_feet.imu.alignment.estimator import AlignmentEstimator
from rhot_feet.imu.samples import FusedImuConverter, ImuSamples, up_rotation

SIGMA_M = 0.003


@pytest.mark.parametrize("yaw_rad", [-2.5, 0.0, 3.1])
def test_alignment_is_learnt_from_the_first_steps(yaw_rad: float) -> None:
    walk = Walk(yaw_rad=yaw_rad)
    learner = AlignmentEstimator(up_rotation(np.array([0.0, 1.0, 0.0])), np.zeros(3))
    t = np.arange(-1.0, 3.0, 0.01)
    samples = FusedImuConverter().convert(np.array([ns(x) for x in t]), *walk.imu(t, 2))
    rotations = rotation_from_quaternion(samples.orientation_xyzw)
    random = np.random.default_rng(7)
    first = None
    for k, now in enumerate(t):
        learner.add_imu_samples(samples.rows(k, k + 1), rotations[k : k + 1], [False])
        if k % 2:
            position, R = walk.foot(now)
            learner.add_marker(ns(now), position + random.normal(0.0, SIGMA_M, 3), SIGMA_M, R, np.radians(2.0))
        if first is None and learner.solve() is not None:
            first = now
    assert first is not None and first < 1.7
    alignment = learner.solve()
    assert alignment is not None and alignment.mounting_known
    # What the learnt yaw makes of the sensor's own orientation is the sensor's orientation in the rig.
    _, R_sensor = walk.sensor(float(t[-1]))
    c, s = np.cos(alignment.yaw_rad), np.sin(alignment.yaw_rad)
    level = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
    R = up_rotation(np.array([0.0, 1.0, 0.0])) @ level @ rotation_from_quaternion(samples.orientation_xyzw[-1])
    assert np.degrees(np.linalg.norm(rotation_between(R, R_sensor))) < 3.0
    assert np.degrees(np.linalg.norm(rotation_between(alignment.M, walk.R_sensor_foot))) < 3.0


@pytest.mark.parametrize("moving_s", [0.1, 0.6])
def test_a_sensor_that_has_moved_for_long_may_lean(moving_s: float) -> None:
    """What it says of its tilt then is worth less: here it is four degrees off, across the tilt of the foot."""
    C, M = up_rotation(np.array([0.0, 1.0, 0.0])), Walk().R_sensor_foot
    learner = AlignmentEstimator(C, np.zeros(3))
    tilt, lean = rotation_from_vector(np.array([0.17, 0.0, 0.0])), rotation_from_vector(np.array([0.0, 0.07, 0.0]))
    for k in range(100 + round(100 * moving_s)):
        moves = k >= 100
        tilted = k >= 90 + round(100 * moving_s)
        R = (lean @ tilt if tilted else np.eye(3)) @ M.T
        sample = ImuSamples(np.array([ns(0.01 * k)]), 9.81 * R[2:], np.zeros((1, 3)), quaternion_from_rotation(R)[None])
        learner.add_imu_samples(sample, R[None], [not moves])
        if not moves or tilted:
            learner.add_marker(
                ns(0.01 * k), np.zeros(3), SIGMA_M, C @ (tilt if tilted else np.eye(3)), float(np.radians(1.0))
            )
    alignment = learner.solve(at_once=True)
    assert alignment is not None
    # The yaw is zero. A sensor cannot have come to lean so much in a tenth of a second.
    assert alignment.yaw_sigma_rad < 0.2 if moving_s < 0.5 else abs(alignment.yaw_rad) < 2.0 * alignment.yaw_sigma_rad
