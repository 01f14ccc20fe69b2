from __future__ import annotations

import numpy as np
import pytest

from rhot_feet.filter.kinematic import KinematicModel
from rhot_feet.filter.zero_velocity_update import ZUPT, zero_velocity_update
from rhot_feet.imu.zero_velocity_detector import MOVING, ZeroVelocity

STANDS = ZeroVelocity(still=True, speed_sigma=0.01, rate=None)


def test_a_standing_foot_loses_its_velocity_and_a_moving_one_keeps_it() -> None:
    model = KinematicModel()
    state = model.start(np.zeros(3), 1e-4 * np.eye(3), None)
    state.motion[3:6] = [0.3, 0.0, 0.0]
    assert zero_velocity_update(model, state, MOVING, ZUPT.sample_s, gated=True) is state
    stood = zero_velocity_update(model, state, STANDS, ZUPT.sample_s, gated=True)
    assert np.linalg.norm(stood.motion[3:6]) < 0.001
    # Samples that follow each other four times as fast say half as much each.
    often = zero_velocity_update(model, state, STANDS, ZUPT.sample_s / 4.0, gated=True)
    assert np.sqrt(often.P[3, 3]) == pytest.approx(2.0 * np.sqrt(stood.P[3, 3]), rel=0.01)


def test_only_a_gated_update_is_refused() -> None:
    model = KinematicModel()
    state = model.start(np.zeros(3), 1e-4 * np.eye(3), None)
    state.P[3:6, 3:6] = 0.01**2 * np.eye(3)
    state.motion[3:6] = [1.0, 0.0, 0.0]
    assert zero_velocity_update(model, state, STANDS, ZUPT.sample_s, gated=True) is state
    assert zero_velocity_update(model, state, STANDS, ZUPT.sample_s, gated=False).motion[3] < 0.9
