from __future__ import annotations

import numpy as np
import pytest

from rhot.arrays import FloatArray
from rhot_tools.measures.streams import delay_s, stream_delay


def path(t_s: FloatArray) -> FloatArray:
    return np.stack([0.1 * np.sin(5.0 * t_s), 0.07 * np.cos(3.1 * t_s), 0.05 * np.sin(8.0 * t_s)], axis=1)


@pytest.mark.parametrize("late_ms", [-12.3, 0.0, 0.7, 3.9, 25.0])
def test_delay_is_found_to_a_tenth_of_a_millisecond(late_ms: float) -> None:
    rng = np.random.default_rng(0)
    t_s, true_t_s = np.arange(0.0, 8.0, 1 / 120), np.arange(-0.2, 8.2, 0.002)
    found = path(t_s - late_ms / 1e3) + rng.normal(0.0, 0.0005, (len(t_s), 3)) + np.array([0.01, -0.02, 0.0])
    found[::17] = np.nan
    assert delay_s(t_s, found, true_t_s, path(true_t_s)) * 1e3 == pytest.approx(late_ms, abs=0.1)


def test_only_used_samples_count() -> None:
    t_s, true_t_s = np.arange(0.0, 8.0, 1 / 120), np.arange(-0.2, 8.2, 0.002)
    found = path(t_s - 0.010)
    wrong = (np.arange(len(t_s)) % 3 == 0)[:, None]
    found = np.where(wrong, path(t_s - 0.050), found)
    used = np.repeat(~wrong, 3, axis=1)
    assert delay_s(t_s, found, true_t_s, path(true_t_s), used) * 1e3 == pytest.approx(10.0, abs=0.1)


def test_no_motion_or_too_little_tells_nothing() -> None:
    t_s, true_t_s = np.arange(0.0, 2.0, 1 / 60), np.arange(-0.2, 2.2, 0.002)
    assert np.isnan(delay_s(t_s, np.zeros((len(t_s), 3)), true_t_s, np.zeros((len(true_t_s), 3))))
    assert np.isnan(delay_s(t_s[:3], path(t_s[:3]), true_t_s, path(true_t_s)))


@pytest.mark.parametrize("late_frames", [0.0, 0.4, 2.0])
def test_stream_delay(late_frames: float) -> None:
    t = np.arange(600) / 30.0
    u = np.stack([320.0 + 100.0 * np.sin(2.0 * t), 300.0 + 60.0 * np.sin(3.3 * t + 1.0)], axis=1)
    late = t - late_frames / 30.0
    x = np.stack([0.2 * np.sin(2.0 * late), 0.1 * np.sin(3.3 * late + 1.0)], axis=1)
    assert stream_delay(u, x, np.ones(u.shape, dtype=bool)) == pytest.approx(late_frames, abs=0.1)
