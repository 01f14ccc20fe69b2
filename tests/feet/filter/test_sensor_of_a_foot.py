"""The sensor on a foot: how it is aligned, and what corrects it."""

from __future__ import annotations

import numpy as np
import pytest
from foot_walk import LATE_S, ROTATION_SIGMA, SIGMA_M, Walk, follow, ns

from rhot.geometry.rotations import (
    rotation_between,
    rotation_from_quaternion,
    rotation_from_vector,
)
from rhot_feet.filter.foot_filter import FootFilter
from rhot_feet.filter.inertial import InertialModel
from rhot_feet.filter.model import FootMotion, Observation
from rhot_feet.filter.strapdown import ATTITUDE, InertialNoise, InertialState, Strapdown
from rhot_feet.imu.alignment.equations import Alignment
from rhot_feet.imu.samples import up_rotation
from rhot_feet.imu.track import InertialStep


def test_a_foot_that_is_never_seen_swinging_is_aligned_by_its_first_step() -> None:
    """Seen only while it stands, as feet of a walking person mostly are; the second step is hidden altogether."""
    foot = FootFilter()
    track = follow(Walk(), 1.7, foot, seen=lambda t: t < 0.0 or 0.55 < t < 1.1)
    assert foot.aligned
    hidden = (track.t > 1.1 + LATE_S) & (track.t < 1.65)
    assert track.error_m[hidden].max() < 0.12
    assert (track.error_m[hidden] < 4.0 * np.array([state.sigma_m for state in track.states])[hidden]).all()


def test_a_foot_that_goes_out_of_sight_with_its_first_step_is_carried_by_its_sensor() -> None:
    """A heel lifted in sight tells the yaw well enough for a foot that only the depth image shows then."""
    foot, walk = FootFilter(), Walk()
    follow(walk, 0.18, foot, seen=lambda t: t < 0.14)
    aligned_in_sight = foot.aligned
    assert foot.update_depth(ns(0.17), walk.foot(0.17)[0], 0.01**2 * np.eye(3))
    assert foot.aligned and not aligned_in_sight
    state = foot.state(ns(0.17))
    assert state is not None
    turned = rotation_between(rotation_from_quaternion(state.orientation_xyzw), walk.foot(0.17)[1])
    assert np.degrees(np.linalg.norm(turned)) < 6.0
    assert turned @ np.linalg.solve(state.orientation_covariance, turned) < 9.0


def test_a_foot_that_stands_tells_nothing_of_the_yaw_of_its_sensor() -> None:
    """Corrections of tilt and lever must not make the filter believe that it knows the yaw."""
    C, random = up_rotation(np.array([0.0, 1.0, 0.0])), np.random.default_rng(5)
    model = InertialModel(Strapdown(np.array([0.0, -9.81, 0.0]), InertialNoise()), C)
    walk, yaw_sigma = Walk(), float(np.radians(10.0))
    position, R_foot = walk.foot(-1.0)
    R_sensor = R_foot @ walk.R_sensor_foot.T
    # The sensor's own idea of up is three degrees off, the lever ten centimetres.
    wrong = rotation_from_vector(np.radians([2.0, 0.0, -2.0])) @ R_sensor
    alignment = Alignment(
        0.0, yaw_sigma, np.zeros(3), np.zeros(3), np.diag(np.repeat([0.01, 0.01], 3)), np.zeros(6),
        wrong.T @ R_foot, True,
    )  # fmt: skip
    motion = FootMotion(position, np.zeros(3), R_foot, 1e-4 * np.eye(3), 1e-2 * np.eye(3))
    state = model.start(alignment, C.T @ wrong, motion, np.zeros(3), stands=True)
    force = R_sensor.T @ np.array([0.0, 9.81, 0.0])
    step = InertialStep(0.01, force, force, np.zeros(3))
    for k in range(200):
        state = model.zero_velocity_update(model.predict(state, 0.01, step), 0.01, None)
        if k % 2:
            seen = rotation_from_vector(random.normal(0.0, ROTATION_SIGMA, 3)) @ R_foot
            at = position + random.normal(0.0, SIGMA_M, 3)
            spread = ROTATION_SIGMA**2 * np.eye(3)
            state = model.update(state, Observation(0, at, SIGMA_M**2 * np.eye(3), seen, spread, "marker"))
    off = rotation_between(R_sensor, state.R)
    assert np.degrees(np.hypot(off[0], off[2])) < 1.0
    assert np.sqrt(state.P[ATTITUDE, ATTITUDE][1, 1]) > 0.9 * yaw_sigma


def test_what_the_depth_image_shows_corrects_the_tilt_that_led_the_foot_astray() -> None:
    model = InertialModel(
        Strapdown(np.array([0.0, -9.81, 0.0]), InertialNoise()), up_rotation(np.array([0.0, 1.0, 0.0]))
    )
    nothing = np.zeros(3)
    P = np.diag(np.repeat([1e-4, 1e-4, 1e-3, 1e-6, 1e-6, 1e-6, 1e-6], 3))
    state = InertialState(nothing, nothing, np.eye(3), nothing, nothing, nothing, np.eye(3), P)
    # The foot hangs still, and its sensor is tilted by two degrees.
    tilted = rotation_from_vector(np.radians([0.0, 0.0, 2.0]))
    force = tilted @ np.array([0.0, 9.81, 0.0])
    step = InertialStep(1.0 / 60.0, force, force, nothing)
    for _ in range(60):
        state = model.predict(state, 1.0 / 60.0, step)
        state = model.update(state, Observation(0, nothing, 0.01**2 * np.eye(3), None, np.eye(3), "depth"))
    assert float(np.linalg.norm(state.position)) < 0.01
    assert float(np.degrees(np.linalg.norm(rotation_between(state.R, tilted.T)))) < 0.5


def test_sensor_pulled_out_and_plugged_in_again_with_another_north() -> None:
    foot = FootFilter()
    track = follow(
        Walk(), 7.5, foot, sensor=lambda t: not 4.0 < t < 5.5, turn_yaw_rad=lambda t: 2.0 if t > 5.0 else 0.0
    )
    away = (track.t > 4.5) & (track.t < 5.4)
    assert track.error_m[away].mean() < 0.025
    assert foot.aligned
    assert track.after(6.2).mean() < 0.004


def test_alignment_is_not_claimed_without_motion() -> None:
    walk = Walk(stride_m=0.0, height_m=0.0, pitch_rad=0.0, heading_rad=0.0)
    foot = FootFilter()
    follow(walk, 3.0, foot)
    assert not foot.aligned


@pytest.mark.parametrize("rate_hz", [60.0, 120.0])
def test_places_out_of_the_depth_image_share_their_errors(rate_hz: float) -> None:
    """Twice as many in the same time tell hardly more."""
    foot = FootFilter()
    follow(Walk(), 1.7, foot, seen=lambda t: t < 0.0 or 0.55 < t < 1.1)
    assert foot.aligned
    for t in np.arange(1.5, 1.6, 1.0 / rate_hz):
        assert foot.update_depth(ns(float(t)), Walk().foot(float(t))[0], 0.04**2 * np.eye(3))
    state = foot.state(ns(1.6))
    assert state is not None
    assert 0.040 < state.sigma_m < 0.043
