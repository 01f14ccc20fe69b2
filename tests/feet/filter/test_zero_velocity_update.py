from __future__ import annotations

import numpy as np
import pytest

from rhot.geometry.rotations import rotation_z
from rhot_feet.filter.inertial import InertialModel
from rhot_feet.filter.kinematic import KinematicModel
from rhot_feet.filter.strapdown import InertialNoise, InertialState, Strapdown
from rhot_feet.filter.zero_velocity_update import zero_velocity_update
from rhot_feet.imu.zero_velocity_detector import MOVING, SAMPLE_S, ZeroVelocity

STANDS = ZeroVelocity(still=True, speed_sigma=0.01, rate=None)
NO_RATE = np.zeros(3)


def test_a_standing_foot_loses_its_velocity_and_a_moving_one_keeps_it() -> None:
    model = KinematicModel()
    state = model.start(np.zeros(3), 1e-4 * np.eye(3), None)
    state.motion[3:6] = [0.3, 0.0, 0.0]
    assert zero_velocity_update(model, state, MOVING, NO_RATE, SAMPLE_S, 0.0, seen=True)[0] is state
    stood, _ = zero_velocity_update(model, state, STANDS, NO_RATE, SAMPLE_S, 0.0, seen=True)
    assert np.linalg.norm(stood.motion[3:6]) < 0.001
    # Samples that follow each other four times as fast say half as much each.
    often, _ = zero_velocity_update(model, state, STANDS, NO_RATE, SAMPLE_S / 4.0, 0.0, seen=True)
    assert np.sqrt(often.P[3, 3]) == pytest.approx(2.0 * np.sqrt(stood.P[3, 3]), rel=0.01)


def test_what_contradicts_the_filter_is_refused_for_a_while_and_while_the_foot_is_seen_for_ever() -> None:
    model = KinematicModel()
    state = model.start(np.zeros(3), 1e-4 * np.eye(3), None)
    state.P[3:6, 3:6] = 0.01**2 * np.eye(3)
    state.motion[3:6] = [1.0, 0.0, 0.0]
    refused_s = 0.0
    for sample in range(1, 40):
        after, refused_s = zero_velocity_update(model, state, STANDS, NO_RATE, SAMPLE_S, refused_s, seen=False)
        if after is not state:
            break
        assert refused_s == pytest.approx(sample * SAMPLE_S)
    assert 0.05 < sample * SAMPLE_S < 0.1
    assert refused_s == 0.0
    assert after.motion[3] < 0.9
    assert zero_velocity_update(model, state, MOVING, NO_RATE, SAMPLE_S, 0.03, seen=False) == (state, 0.03)
    assert zero_velocity_update(model, state, STANDS, NO_RATE, SAMPLE_S, 10.0, seen=True)[0] is state


def test_a_foot_that_rolls_moves_about_where_it_touches_the_floor() -> None:
    """A sensor 0.1 m above the floor, turned with its toes down at 0.8 rad/s, moves forwards at 0.08 m/s."""
    model, zero = InertialModel(Strapdown(np.array([0.0, 0.0, -9.81]), InertialNoise()), np.eye(3)), np.zeros(3)
    forwards, toes_down = np.array([0.0, 0.08, 0.0]), np.array([-0.8, 0.0, 0.0])
    P = np.diag(np.repeat([1e-6, 0.04, 1e-4, 1e-6, 1e-8, 1e-6, 1e-6], 3))
    # The sensor is worn turned by a quarter.
    R = rotation_z(np.pi / 2.0)
    state = InertialState(zero, forwards, R, zero, zero, zero, np.eye(3), P)
    rolls = ZeroVelocity(still=False, speed_sigma=0.01, rate=None, rolls_m=0.1)
    rate = R.T @ toes_down
    rolled, _ = zero_velocity_update(model, state, rolls, rate, SAMPLE_S, 0.0, seen=True)
    stopped, _ = zero_velocity_update(model, state, STANDS, rate, SAMPLE_S, 0.0, seen=True)
    assert rolled.velocity == pytest.approx(forwards, abs=1e-9)
    assert np.linalg.norm(stopped.velocity) < 0.001
