from __future__ import annotations

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from rhot.arrays import FloatArray
from rhot_sim.world.motion import basis, bump, evaluate_spline, ramp


def control_of(knot: int) -> FloatArray:
    rng = np.random.default_rng(knot + 1000)
    return rng.uniform(-1.0, 1.0, 3)


@given(st.floats(0.0, 1.0))
def test_weights_are_positive_and_sum_to_one(u: float) -> None:
    weights = basis(np.array([u]))[0]
    assert weights.min() >= 0.0
    assert abs(weights.sum() - 1.0) < 1e-12


@settings(max_examples=50, deadline=None)
@given(st.lists(st.floats(-50.0, 500.0), min_size=1, max_size=20))
def test_times_far_apart_give_what_each_gives_alone(times: list[float]) -> None:
    together = evaluate_spline(np.array(times), 0.1, control_of)
    alone = np.concatenate([evaluate_spline(np.array([t]), 0.1, control_of) for t in times])
    np.testing.assert_allclose(together, alone, atol=1e-12)
    assert np.abs(together).max() <= 1.0


def test_second_derivative_is_continuous_across_knots() -> None:
    h = 1e-4
    for knot in range(1, 20):
        t: FloatArray = knot * 0.1 + h * np.arange(-3, 4, dtype=np.float64)
        second = np.diff(evaluate_spline(t, 0.1, control_of), 2, axis=0) / h**2
        # Third derivatives of such a curve are at most 8 / 0.1³ = 8000 per s³.
        assert np.abs(np.diff(second, axis=0)).max() < 8000.0 * 2.0 * h


def test_equal_controls_stand_still() -> None:
    curve = evaluate_spline(np.linspace(0.0, 3.0, 50), 0.1, lambda _: np.array([0.25, -3.0]))
    np.testing.assert_allclose(curve, np.tile([0.25, -3.0], (50, 1)), atol=1e-14)


def test_ramp_and_bump_reach_their_ends() -> None:
    t = np.array([-1.0, 1.0, 1.5, 2.0, 9.0])
    np.testing.assert_allclose(ramp(t, 1.0, 2.0), [0.0, 0.0, 0.5, 1.0, 1.0])
    np.testing.assert_allclose(bump(np.array([0.9, 1.5, 2.0, 2.5, 3.1]), 1.0, 3.0, 0.5), [0.0, 1.0, 1.0, 1.0, 0.0])
