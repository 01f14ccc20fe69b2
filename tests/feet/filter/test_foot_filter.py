"""The filter of one foot: walking, standing, false and late measurements."""

from __future__ import annotations

import pickle

import numpy as np
import pytest
from foot_walk import SIGMA_M, Walk, follow, ns

from rhot_bench.thesis.feet import ThesisFilter
from rhot_feet.filter.foot_filter import FootFilter
from rhot_feet.filter.model import FootFilterSettings
from rhot_feet.imu.alignment.estimator import AlignmentEstimator
from rhot_feet.imu.samples import ImuSamples


def test_walking_with_sensor_and_marker() -> None:
    foot = FootFilter()
    track = follow(Walk(), 6.0, foot)
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


def test_a_restart_keeps_what_is_known_of_a_sensor_that_does_not_carry_the_foot(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    foot = FootFilter(FootFilterSettings(agreeing=4))
    forgotten: list[None] = []
    monkeypatch.setattr(AlignmentEstimator, "reset", lambda _self: forgotten.append(None))
    for k in range(40):
        foot.update_marker(ns(k / 60.0), np.array([float(k >= 20), 0.0, 0.0]), SIGMA_M**2 * np.eye(3))
    assert foot.counts.restarts == 1
    assert not forgotten


def test_false_markers_do_not_move_it() -> None:
    foot = FootFilter()
    track = follow(Walk(), 6.0, foot, false_share=0.1, seed=3)
    assert track.after(3.0).max() < 0.020
    assert foot.counts.gated > 30


def test_a_marker_that_is_really_elsewhere_is_followed() -> None:
    """After enough observations that agree the filter starts over there."""
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
    longer = FootFilter()
    follow(Walk(), 5.0, longer)
    assert len(pickle.dumps(longer)) < 1.1 * len(pickle.dumps(foot)), "two more seconds are not kept"


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
