"""Intervals hold the truth as often as they say, also of samples that are alike."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.signal import lfilter

from rhot.arrays import FloatArray
from rhot_tools.rig.statistics import deviation, mean, root_mean_square, spread_of_stretches

RECORDS = 200


def records(rho: float, count: int) -> list[FloatArray]:
    """Samples of standard deviation 1 about 0, each ρ times the one before, and noise."""
    rng = np.random.default_rng(7)
    noise = rng.normal(size=(RECORDS, count + 400))
    return list(lfilter([np.sqrt(1.0 - rho**2)], [1.0, -rho], noise)[:, 400:])


@pytest.mark.parametrize(("rho", "count"), [(0.0, 300), (0.8, 1200), (0.95, 3600)])
def test_intervals_hold_the_truth_in_95_of_100_cases(rho: float, count: int) -> None:
    drawn = records(rho, count)
    held = np.mean([(deviation(each).holds(1.0), mean(each).holds(0.0)) for each in drawn], axis=0)
    # 95 % of 200 is off by more than 5 points once in a thousand.
    assert held == pytest.approx([0.95, 0.95], abs=0.05)


def test_alike_samples_count_for_fewer() -> None:
    (first, *_) = records(0.9, 4000)
    found = mean(first)
    # (1 + ρ) / (1 − ρ) = 19 samples tell as much as one.
    assert found.independent == pytest.approx(4000 / 19.0, rel=0.4)
    assert found.half_width > 3.0 * mean(np.random.default_rng(1).normal(size=4000)).half_width


@pytest.mark.parametrize("rho", [0.0, 0.8])
def test_stretches_of_one_process_hold_its_deviation(rho: float) -> None:
    drawn = records(rho, 3000)
    # 100 samples about their own middle miss what is slower than they are.
    within = np.sqrt((100.0 - (1.0 + rho) / (1.0 - rho)) / 99.0)
    pieces = [[piece[:, None] - piece.mean() for piece in np.array_split(each, 30)] for each in drawn]
    held = [spread_of_stretches(each).scaled(np.sqrt(100.0 / 99.0)).holds(within) for each in pieces]
    assert np.mean(held) == pytest.approx(0.95, abs=0.05)


def test_no_deviation_reaches_below_zero() -> None:
    drawn = [np.random.default_rng(seed).standard_t(2.1, 40) for seed in range(50)]
    found = [figure for each in drawn for figure in (deviation(each), root_mean_square(each))]
    assert all(np.isnan(figure.low) or 0.0 < figure.low < figure.value < figure.high for figure in found)
    assert sum(np.isfinite(figure.low) for figure in found) > 40


def test_axes_add_up_and_units_scale() -> None:
    noise = np.random.default_rng(3).normal(0.0, (3.0, 4.0), (5000, 2))
    found = deviation(noise)
    assert found.holds(5.0)
    assert found.scaled(1e3).holds(5e3)


def test_too_little_tells_no_interval() -> None:
    for values in (np.empty(0), np.ones(1), np.arange(10.0)):
        assert np.isnan(mean(values).low)
        assert np.isnan(deviation(values).low)
        assert not mean(values).holds(float(values.mean()) if values.size else 0.0)
    assert deviation(np.ones(100)).value == 0.0
