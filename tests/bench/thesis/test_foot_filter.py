"""The 2021 thesis's filter: its own values, as printed, decide what comes out."""

from __future__ import annotations

import numpy as np
import pytest

from rhot_bench.thesis.feet import ThesisFilter
from rhot_feet.imu.samples import GRAVITY_M_S2, ImuSamples

UNUSED = np.eye(3)
STRAIGHT = np.array([0.0, 0.0, 0.0, 1.0])
MS = 1_000_000
HERE, THERE = np.zeros(3), np.array([0.1, 0.0, 0.0])


def imu_samples(t_ns: list[int], along_x: float) -> ImuSamples:
    """A level sensor, its z up, that accelerates along its x, m/s²."""
    count = len(t_ns)
    force = np.tile([along_x, 0.0, GRAVITY_M_S2], (count, 1))
    return ImuSamples(np.array(t_ns), force, np.zeros((count, 3)), np.tile(STRAIGHT, (count, 1)))


def position_after(tracker: ThesisFilter, t_ns: int) -> float:
    state = tracker.state(t_ns)
    assert state is not None
    return float(state.position[0])


def test_gain_follows_from_the_printed_covariances() -> None:
    """10 ms after a first marker the prior is F P F' + Q with P from P0, and R of a depth blob is 0.35."""
    tracker = ThesisFilter()
    tracker.update_marker(0, HERE, UNUSED)
    tracker.update_depth(10 * MS, THERE, UNUSED)
    h = 0.01
    position = 1.0 * 0.00015 / (1.0 + 0.00015)
    prior = position + h**2 * 0.5625 + 0.25 * h**4 * 225.0 + 0.0002
    assert position_after(tracker, 10 * MS) == pytest.approx(0.1 * prior / (prior + 0.35), rel=1e-9)


def test_process_noise_is_added_once_per_measurement() -> None:
    """Whatever the time between two: the second of two depth blobs is believed as much after 0.1 as after 10 us."""
    gains = []
    for step_ns in (10_000, 100):
        tracker = ThesisFilter()
        tracker.update_marker(0, HERE, UNUSED)
        tracker.update_depth(step_ns, THERE, UNUSED)
        gains.append(position_after(tracker, step_ns))
    assert gains[0] == pytest.approx(gains[1], rel=1e-4)
    assert gains[0] == pytest.approx(0.1 * (0.00015 + 0.0002) / (0.35 + 0.00035), rel=1e-3)


def test_at_rest_the_position_is_kept() -> None:
    tracker = ThesisFilter()
    for k in range(30):
        tracker.update_marker(10 * k * MS, k * 0.01 * np.array([1.0, 0.0, 0.0]), UNUSED, STRAIGHT)
    moving = tracker.state(290 * MS)
    assert moving is not None
    assert np.linalg.norm(moving.velocity) > 0.5
    tracker.add_imu_samples(imu_samples([300 * MS], 0.49))
    resting = [tracker.state(t * MS) for t in (300, 900)]
    assert all(state is not None and np.allclose(state.velocity, 0.0) and state.stationary for state in resting)
    tracker.add_imu_samples(imu_samples([900 * MS], 0.49))
    for _ in range(100):
        last = tracker.state(900 * MS)
    assert last is not None
    assert last.position[0] == pytest.approx(0.29, abs=0.005)


def test_readings_are_smoothed_by_a_fifth() -> None:
    tracker = ThesisFilter()
    tracker.update_marker(0, HERE, UNUSED)
    assert position_after(tracker, 0) == pytest.approx(0.0)
    tracker.update_marker(1, THERE, UNUSED)
    first = position_after(tracker, 1)
    second = position_after(tracker, 1)
    filtered = 5.0 * first
    assert second == pytest.approx(first + 0.2 * (filtered - first), rel=1e-6)


def test_an_acceleration_moves_the_foot() -> None:
    tracker = ThesisFilter()
    tracker.add_imu_samples(imu_samples([0], 0.0))
    tracker.update_marker(1, HERE, UNUSED, STRAIGHT)
    tracker.add_imu_samples(imu_samples([10 * MS * k for k in range(1, 51)], 2.0))
    state = tracker.state(500 * MS)
    assert state is not None
    assert np.linalg.norm(state.velocity) > 0.5
