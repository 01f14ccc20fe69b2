from __future__ import annotations

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from rhot_bench.thesis.paired.one_euro import Axes, OneEuroFilter, OneEuroSettings, smoothing_factor

SETTINGS = OneEuroSettings(min_cutoff_hz=2.0, beta=5.0, derivative_cutoff_hz=1.0)
ALL = np.arange(2)


def scalar_one_euro(values: list[float], times: list[float], settings: OneEuroSettings) -> list[float]:
    """The published algorithm for one number, written down step by step."""
    filtered = [values[0]]
    speed = 0.0
    for before, value, t0, t1 in zip(values, values[1:], times, times[1:], strict=False):
        interval = t1 - t0

        def alpha(cutoff: float, interval: float = interval) -> float:
            tau = 1.0 / (2.0 * np.pi * cutoff)
            return float(1.0 / (1.0 + tau / interval))

        speed += alpha(settings.derivative_cutoff_hz) * ((value - before) / interval - speed)
        a = alpha(settings.min_cutoff_hz + settings.beta * abs(speed))
        filtered.append(a * value + (1.0 - a) * filtered[-1])
    return filtered


samples = st.lists(st.tuples(st.floats(-1.0, 1.0), st.floats(0.002, 0.1)), min_size=2, max_size=20)


@settings(deadline=None, max_examples=40)
@given(samples)
def test_array_filter_equals_the_published_scalar_one(steps: list[tuple[float, float]]) -> None:
    values = [value for value, _ in steps]
    times = np.cumsum([interval for _, interval in steps]).tolist()
    expected = scalar_one_euro(values, times, SETTINGS)
    filters = OneEuroFilter(2, SETTINGS)
    filters.start(ALL, np.array([[values[0], -values[0], 0.0]] * 2), times[0])
    for value, t_s, want in zip(values[1:], times[1:], expected[1:], strict=True):
        filters.update(ALL, np.array([[value, -value, 0.0]] * 2), t_s)
        np.testing.assert_allclose(filters.value, [[want, -want, 0.0]] * 2, atol=1e-12)


@settings(deadline=None, max_examples=40)
@given(samples)
def test_output_stays_within_the_range_of_its_input(steps: list[tuple[float, float]]) -> None:
    filters = OneEuroFilter(1, SETTINGS)
    t_s = 0.0
    index = np.array([0])
    filters.start(index, np.full((1, 3), steps[0][0]), t_s)
    for value, interval in steps[1:]:
        t_s += interval
        filters.update(index, np.full((1, 3), value), t_s)
        seen = [one for one, _ in steps]
        assert min(seen) - 1e-12 <= filters.value[0, 0] <= max(seen) + 1e-12


def test_slow_noise_is_damped_and_fast_motion_is_followed() -> None:
    rng = np.random.default_rng(1)
    settings = OneEuroSettings(min_cutoff_hz=1.0, beta=20.0, derivative_cutoff_hz=5.0)
    filters = OneEuroFilter(1, settings)
    index = np.array([0])
    filters.start(index, np.zeros((1, 3)), 0.0)
    noise = rng.normal(0.0, 1e-3, (600, 3))
    out = []
    for number, value in enumerate(noise, start=1):
        filters.update(index, value[None], number / 60.0)
        out.append(filters.value[0].copy())
    assert np.std(out[60:]) < 0.45 * 1e-3
    for number in range(601, 661):
        filters.update(index, np.full((1, 3), (number - 600) / 60.0), number / 60.0)
    # At 1 m/s the cut-off is 21 Hz: a lag of 7.6 ms, not the 160 ms of the cut-off at rest.
    assert abs(1.0 - filters.value[0, 0]) < 0.010


def test_each_point_and_axis_is_filtered_alone() -> None:
    filters = OneEuroFilter(2, SETTINGS)
    filters.start(ALL, np.zeros((2, 3)), 0.0)
    filters.update(np.array([1]), np.array([[0.0, 1.0, 0.0]]), 0.02)
    assert (filters.value[0] == 0.0).all()
    assert filters.value[1, 1] > 0.1
    assert filters.value[1, 0] == filters.value[1, 2] == 0.0
    assert filters.t_s.tolist() == [0.0, 0.02]


def test_sample_of_no_later_time_moves_nothing() -> None:
    filters = OneEuroFilter(1, SETTINGS)
    index = np.array([0])
    filters.start(index, np.zeros((1, 3)), 1.0)
    filters.update(index, np.ones((1, 3)), 1.0)
    filters.update(index, np.ones((1, 3)), 0.5)
    assert (filters.value == 0.0).all()
    assert filters.t_s[0] == 1.0


def test_expected_motion_does_not_lag() -> None:
    filters = OneEuroFilter(1, SETTINGS)
    index = np.array([0])
    filters.start(index, np.zeros((1, 3)), 0.0)
    for number in range(1, 10):
        filters.update(index, np.full((1, 3), 0.01 * number), 0.02 * number, advance=np.full((1, 3), 0.01))
    np.testing.assert_allclose(filters.value, 0.09, atol=1e-12)


@settings(deadline=None, max_examples=20)
@given(st.floats(0.0, 6.28))
def test_turned_axes_give_turned_results(angle: float) -> None:
    c, s = np.cos(angle), np.sin(angle)
    basis = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
    scale = np.array([[1.0, 0.3, 0.1]])
    results = []
    for turn in (np.eye(3), basis):
        filters = OneEuroFilter(1, SETTINGS)
        index = np.array([0])
        filters.start(index, np.zeros((1, 3)), 0.0)
        for number in range(1, 6):
            sample = turn @ np.array([0.1 * number, 0.02 * number**2, -0.05])
            filters.update(index, sample[None], 0.03 * number, Axes(turn[None], scale, scale))
        results.append(filters.value[0].copy())
    np.testing.assert_allclose(results[1], basis @ results[0], atol=1e-12)


def test_smoothing_factor_is_zero_for_no_time_and_near_one_for_long() -> None:
    factors = smoothing_factor(2.0, np.array([0.0, 0.01, 100.0]))
    assert factors[0] == 0.0
    assert factors[1] == np.float64(2 * np.pi * 0.02 / (1 + 2 * np.pi * 0.02))
    assert factors[2] > 0.999
