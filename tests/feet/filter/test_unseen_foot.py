"""A foot that is not seen for a while."""

from __future__ import annotations

import numpy as np
import pytest
from foot_walk import LATE_S, SIGMA_M, Walk, follow, ns

from rhot.geometry.rotations import (
    quaternion_from_rotation,
    rotation_from_vector,
)
from rhot_feet.filter.foot_filter import FootFilter
from rhot_feet.imu.samples import ImuSamples


def test_hidden_in_steps() -> None:
    """Hidden for a second each time: by the sensor alone within 60 mm, and right again as soon as it is seen."""
    foot = FootFilter()
    track = follow(Walk(), 9.0, foot, seen=lambda t: t < 4.0 or t % 2.3 > 1.0)
    alone = track.stages("inertial")
    assert alone.sum() > 100
    assert track.error_m[alone].max() < 0.040
    back = (track.t > 4.0) & track.stages("marker") & (track.t % 2.3 > 1.0 + LATE_S)
    assert track.error_m[back].max() < 0.020
    sigma = np.array([state.sigma_m for state in track.states])[alone]
    assert sigma.mean() < 0.05 and (track.error_m[alone] < 4.0 * sigma).all()


def test_a_sensor_that_is_not_aligned_still_tells_that_the_foot_sets_off() -> None:
    """A foot that has stood for long is not trusted to stand on while its sensor is shaken."""
    sigmas = []
    for force in (0.0, 23.0):
        foot = FootFilter()
        t_ns = np.array([ns(0.01 * k) for k in range(80)])
        forces = np.tile([0.0, 0.0, 9.81], (80, 1))
        forces[72:, 0] = force
        upright = np.tile([0.0, 0.0, 0.0, 1.0], (80, 1))
        for k in range(80):
            foot.add_imu_samples(ImuSamples(t_ns[k : k + 1], forces[k : k + 1], np.zeros((1, 3)), upright[k : k + 1]))
            if k < 72:
                foot.update_marker(int(t_ns[k]), np.zeros(3), SIGMA_M**2 * np.eye(3))
        state = foot.state(int(t_ns[-1]))
        assert state is not None
        sigmas.append(state.sigma_m)
    assert sigmas[0] < 0.01
    assert sigmas[1] > 0.03


def test_a_foot_unseen_is_about_as_it_was_turned_even_when_it_is_found_elsewhere_by_depth() -> None:
    foot, covariance = FootFilter(), SIGMA_M**2 * np.eye(3)
    orientation = quaternion_from_rotation(rotation_from_vector(np.array([0.1, 0.8, 0.0])))
    for k in range(30):
        foot.update_marker(ns(k / 60.0), np.zeros(3), covariance, orientation)
    for k in range(30, 50):
        foot.update_depth(ns(k / 60.0), np.array([3.0, 0.0, 0.0]), covariance)
    state = foot.state(ns(50 / 60.0))
    assert foot.counts.restarts == 1
    assert state is not None and abs(state.position[0] - 3.0) < 0.01
    assert abs(float(state.orientation_xyzw @ orientation)) > 0.99
    assert np.degrees(np.sqrt(state.orientation_covariance[0, 0])) < 61.0


@pytest.mark.parametrize(("shaken", "held"), [(False, True), (True, False)])
def test_a_foot_felt_to_stand_ever_since_it_was_seen_counts_as_seen(shaken: bool, held: bool) -> None:
    foot = FootFilter()
    forces = np.tile([0.0, 0.0, 9.81], (200, 1))
    forces[100:110, 0] = 8.0 * shaken
    for k, force in enumerate(forces):
        foot.add_imu_samples(
            ImuSamples(np.array([ns(0.01 * k)]), force[None], np.zeros((1, 3)), np.array([[0.0, 0.0, 0.0, 1.0]]))
        )
        if k < 80:
            foot.update_marker(ns(0.01 * k), np.zeros(3), SIGMA_M**2 * np.eye(3))
    state = foot.state(ns(1.99))
    assert state is not None and state.stationary
    assert (state.measured_ns == ns(1.99)) is held


@pytest.mark.parametrize("turned_deg", [0.0, 10.0])
def test_a_foot_stood_while_samples_were_lost_if_it_is_as_it_was_before(turned_deg: float) -> None:
    foot, still = FootFilter(), np.array([[0.0, 0.0, 0.0, 1.0]])
    after = quaternion_from_rotation(rotation_from_vector(np.radians([0.0, 0.0, turned_deg])))[None]
    for k in (*range(60), *range(75, 90)):
        orientation = still if k < 60 else after
        foot.add_imu_samples(
            ImuSamples(np.array([ns(0.01 * k)]), np.array([[0.0, 0.0, 9.81]]), np.zeros((1, 3)), orientation)
        )
        if k < 40:
            foot.update_marker(ns(0.01 * k), np.zeros(3), SIGMA_M**2 * np.eye(3))
    state = foot.state(ns(0.9))
    assert state is not None
    assert (state.sigma_m < 0.01) is (turned_deg == 0.0)


def test_unseen_without_a_sensor_holds_the_place_and_says_so() -> None:
    foot = FootFilter()
    track = follow(Walk(), 4.0, foot, sensor=lambda _t: False, seen=lambda t: t < 2.0)
    late = track.t > 2.3
    assert all(state.stage == "lost" for state, is_late in zip(track.states, late, strict=True) if is_late)
    positions = np.array([state.position for state in track.states])[late]
    assert np.linalg.norm(positions - positions[-1], axis=1).max() < 0.02
    assert track.states[-1].sigma_m > 0.5
