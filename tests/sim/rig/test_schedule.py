from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from rhot.rig import CameraConfig
from rhot.rig.config import SimConfig
from rhot_sim.rig.schedule import FrameSchedule, clock_error

CAMERA = CameraConfig(source="simulated", rate_hz=60.0, exposure_s=0.004, readout_s=0.010)


def test_frames_come_at_the_rate_and_out_of_step() -> None:
    config = SimConfig(phase_s=0.007)
    first, second, third = (FrameSchedule("c", index, CAMERA, config) for index in range(3))
    starts = np.array([first.frame(n).t_first_row_s for n in range(100)])
    np.testing.assert_allclose(np.diff(starts), 1 / 60, atol=1e-12)
    assert second.frame(5).t_first_row_s - first.frame(5).t_first_row_s == pytest.approx(0.007)
    assert third.frame(5).t_first_row_s - first.frame(5).t_first_row_s == pytest.approx(0.014)


def test_delivery_follows_read_out_with_the_asked_jitter() -> None:
    schedule = FrameSchedule("left", 0, CAMERA, SimConfig(jitter_s=0.0005))
    frames = [schedule.frame(n) for n in range(4000)]
    late = np.array([frame.delivered_s - frame.t_first_row_s - 0.014 for frame in frames])
    assert late.min() >= 0.0
    assert np.sqrt(np.mean(late**2)) == pytest.approx(0.0005, rel=0.08)


def test_share_of_lost_frames_is_as_asked_and_differs_between_cameras() -> None:
    config = SimConfig(drop_rate=0.05)
    lost = {
        name: np.array([FrameSchedule(name, 0, CAMERA, config).frame(n).dropped for n in range(8000)])
        for name in ("left", "right")
    }
    for dropped in lost.values():
        # Four standard deviations of a binomial share.
        assert dropped.mean() == pytest.approx(0.05, abs=4.0 * np.sqrt(0.05 * 0.95 / 8000))
    assert (lost["left"] != lost["right"]).any()
    assert not any(FrameSchedule("left", 0, CAMERA, SimConfig(drop_rate=0.0)).frame(n).dropped for n in range(2000))


def test_a_late_start_continues_the_same_schedule() -> None:
    early, late = (FrameSchedule("left", 1, CAMERA, SimConfig()) for _ in range(2))
    sequence = [early.frame(n) for n in range(50)]
    assert late.frame(49) == sequence[49]


@settings(max_examples=200, deadline=None)
@given(st.floats(0.0, 1e5), st.integers(0, 5))
def test_first_after_is_the_first(t_s: float, place: int) -> None:
    schedule = FrameSchedule("left", place, CAMERA, SimConfig())
    index = schedule.first_after(t_s)
    assert schedule.frame(index).t_first_row_s >= t_s - 1e-6
    assert index == 0 or schedule.frame(index - 1).t_first_row_s < t_s + 1e-6


def test_clock_errors_stay_within_bounds_and_use_them() -> None:
    config = SimConfig(clock_offset_s=0.2, clock_drift_ppm=40.0)
    errors = [clock_error(f"camera{k}", config) for k in range(300)]
    offsets = np.array([error.offset_ns for error in errors]) / 1e9
    drifts = np.array([error.drift_ppm for error in errors])
    for values, bound in ((offsets, 0.2), (drifts, 40.0)):
        assert np.abs(values).max() <= bound
        assert values.min() < -0.9 * bound < 0.9 * bound < values.max()
    assert clock_error("left", config) == clock_error("left", config)
    assert clock_error("left", SimConfig(clock_offset_s=0.0, clock_drift_ppm=0.0)).offset_ns == 0
