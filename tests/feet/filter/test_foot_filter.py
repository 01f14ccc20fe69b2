from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
import pytest
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
from rhot_feet.filter.inertial import InertialModel
from rhot_feet.filter.model import FootFilterSettings, FootMotion, FootState, Observation
from rhot_feet.filter.strapdown import ATTITUDE, InertialNoise, InertialState, Strapdown
from rhot_feet.imu.alignment.equations import Alignment
from rhot_feet.imu.conversion import FusedImuConverter, up_rotation
from rhot_feet.imu.samples import ImuSamples
from rhot_feet.imu.track import InertialStep

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
    return walk.imu(np.arange(-1.0, 11.0, 0.01), seed)


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


def test_walking_with_sensor_and_marker() -> None:
    foot = FootFilter()
    track = follow(Walk(), 8.0, foot)
    assert foot.aligned
    assert track.after(2.0).mean() < 0.003
    assert track.after(2.0).max() < 0.012
    assert track.turn_deg[track.t > 2.0].mean() < 1.0
    standing = np.array([state.stationary for state in track.states]) & (track.t > 2.0)
    assert 0.3 < standing[track.t > 2.0].mean() < 0.6
    assert track.error_m[standing].mean() < 0.0016
    # What it says of its own error is neither boastful nor shy.
    sigma = np.array([state.sigma_m for state in track.states])[track.t > 2.0]
    assert 0.5 < np.sqrt((track.after(2.0) ** 2).mean()) / np.sqrt((sigma**2).mean()) < 2.0
    assert foot.counts.gated <= 2 and foot.counts.restarts == 0


def test_standing_still_is_below_a_millimetre() -> None:
    track = follow(Walk(stride_m=0.0, height_m=0.0, pitch_rad=0.0, heading_rad=0.0), 5.0, FootFilter())
    assert track.after(1.0).mean() < 0.001
    assert all(state.stationary and state.stage == "marker" for state in track.states[60:])


def test_without_a_sensor() -> None:
    foot = FootFilter()
    track = follow(Walk(), 6.0, foot, sensor=lambda _t: False)
    assert not foot.aligned
    assert track.after(1.0).mean() < 0.025
    assert foot.counts.restarts == 0


def test_hidden_in_steps() -> None:
    """Hidden for a second each time: by the sensor alone within 60 mm, and right again as soon as it is seen."""
    foot = FootFilter()
    track = follow(Walk(), 11.0, foot, seen=lambda t: t < 4.0 or t % 2.3 > 1.0)
    alone = track.stages("inertial")
    assert alone.sum() > 100
    assert track.error_m[alone].max() < 0.040
    back = (track.t > 4.0) & track.stages("marker") & (track.t % 2.3 > 1.0 + LATE_S)
    assert track.error_m[back].max() < 0.020
    sigma = np.array([state.sigma_m for state in track.states])[alone]
    assert sigma.mean() < 0.05 and (track.error_m[alone] < 4.0 * sigma).all()


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


def test_a_foot_that_is_elsewhere_says_nothing_against_a_sensor_that_does_not_carry_it() -> None:
    foot = FootFilter(FootFilterSettings(agreeing=4))
    forgotten: list[None] = []
    foot._alignment.reset = lambda: forgotten.append(None)  # type: ignore[method-assign]
    for k in range(40):
        foot.update_marker(ns(k / 60.0), np.array([float(k >= 20), 0.0, 0.0]), SIGMA_M**2 * np.eye(3))
    assert foot.counts.restarts == 1
    assert not forgotten


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


def test_false_markers_do_not_move_it() -> None:
    foot = FootFilter()
    track = follow(Walk(), 8.0, foot, false_share=0.1, seed=3)
    assert track.after(3.0).max() < 0.020
    assert foot.counts.gated > 30


def test_sensor_pulled_out_and_plugged_in_again_with_another_north() -> None:
    foot = FootFilter()
    track = follow(
        Walk(), 9.0, foot, sensor=lambda t: not 4.0 < t < 5.5, turn_yaw_rad=lambda t: 2.0 if t > 5.0 else 0.0
    )
    away = (track.t > 4.5) & (track.t < 5.4)
    assert track.error_m[away].mean() < 0.025
    assert foot.aligned
    assert track.after(6.2).mean() < 0.004


def test_unseen_without_a_sensor_holds_the_place_and_says_so() -> None:
    foot = FootFilter()
    track = follow(Walk(), 4.0, foot, sensor=lambda _t: False, seen=lambda t: t < 2.0)
    late = track.t > 2.3
    assert all(state.stage == "lost" for state, is_late in zip(track.states, late, strict=True) if is_late)
    positions = np.array([state.position for state in track.states])[late]
    assert np.linalg.norm(positions - positions[-1], axis=1).max() < 0.02
    assert track.states[-1].sigma_m > 0.5


def test_a_marker_that_is_really_elsewhere_is_followed() -> None:
    """After enough observations that agree the filter starts anew there."""
    foot = FootFilter()
    covariance = SIGMA_M**2 * np.eye(3)
    for k in range(60):
        assert foot.update_marker(ns(k / 60.0), np.zeros(3), covariance)
    answers = [foot.update_marker(ns(k / 60.0), np.array([1.0, 0.0, 0.0]), covariance) for k in range(60, 80)]
    assert not any(answers[:6]) and all(answers[8:])
    state = foot.state(ns(80 / 60.0))
    assert state is not None and abs(state.position[0] - 1.0) < 0.01


def test_order_of_arrival_does_not_matter() -> None:
    """A picture that is 100 ms late leads to the same state as one that is not."""
    answers = []
    for late_s in (0.0, 0.1):
        foot = FootFilter()
        follow(Walk(), 3.0, foot, late_s=late_s)
        state = foot.state(ns(2.9))
        assert state is not None
        answers.append(state.position)
    np.testing.assert_allclose(answers[0], answers[1], atol=0.003)


def test_what_is_too_late_is_left_out_and_memory_is_bounded() -> None:
    foot = FootFilter()
    follow(Walk(), 3.0, foot)
    assert not foot.update_marker(ns(1.0), np.zeros(3), np.eye(3) * 1e-6)
    assert foot.counts.late == 1
    history = foot._inertial_history
    assert history is not None and len(history._entries) < 60 and len(foot._imu) < 60


def test_depth_alone_is_smoothed() -> None:
    foot = FootFilter()
    random = np.random.default_rng(0)
    errors = []
    for k in range(180):
        foot.update_depth(ns(k / 60.0), random.normal(0.0, 0.012, 3), 0.012**2 * np.eye(3))
        state = foot.state(ns(k / 60.0))
        assert state is not None and state.stage == "depth"
        errors.append(float(np.linalg.norm(state.position)))
    # Each position alone is 19 mm off on average.
    assert np.mean(errors[60:]) < 0.012


def test_alignment_is_not_claimed_without_motion() -> None:
    walk = Walk(stride_m=0.0, height_m=0.0, pitch_rad=0.0, heading_rad=0.0)
    foot = FootFilter()
    follow(walk, 3.0, foot)
    assert not foot.aligned


def test_thesis_filter_lags_and_ours_does_not() -> None:
    """The same data through the filter of 2021: its smoothing alone costs tens of milliseconds."""
    thesis = follow(Walk(), 5.0, ThesisFilter())
    assert thesis.after(2.0).mean() > 0.02
    assert thesis.states[-1].stage == "marker"
    still = follow(Walk(stride_m=0.0, height_m=0.0, pitch_rad=0.0, heading_rad=0.0), 3.0, ThesisFilter())
    assert still.after(1.5).mean() < 0.005
    assert sum(state.stationary for state in still.states[60:]) > 0.9 * len(still.states[60:])


def test_nothing_is_known_before_it_was_seen() -> None:
    for foot in (FootFilter(), ThesisFilter()):
        foot.add_imu_samples(ImuSamples.none())
        assert foot.state(ns(0.0)) is None
