"""The rig clock: offset and drift recovered from exchanges with asymmetric jitter, with honest bounds."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from rhot.clock import (
    ClockEstimator,
    Exchange,
    LocalRigClock,
    SkewedClock,
    SyncedRigClock,
    SystemClock,
    difference_ns,
)
from rhot.errors import BusError

EPOCH_NS = 1_790_000_000_000_000_000
INTERVAL_NS = 500_000_000


class TrueClocks:
    """A rig clock that is off by `offset_ns` and gains `drift` against the node's."""

    def __init__(self, offset_ns: int, drift: float) -> None:
        self.offset_ns, self.drift = offset_ns, drift

    def rig(self, node_ns: int) -> int:
        return node_ns + self.offset_ns + round(self.drift * node_ns)

    def exchange(self, node_ns: int, up_ns: float, down_ns: float) -> Exchange:
        received, served = node_ns + round(up_ns), 20_000
        return Exchange(node_ns, self.rig(received), self.rig(received + served), received + served + round(down_ns))


def run(clocks: TrueClocks, rng: np.random.Generator, number: int, up_ns: float, down_ns: float) -> tuple[float, float]:
    """Return (largest error, share of bounds that held) over the second half of a run."""
    estimator = ClockEstimator()
    errors, held = [], []
    for k in range(number):
        exchange = clocks.exchange(k * INTERVAL_NS, 2e5 + rng.exponential(up_ns), 2e5 + rng.exponential(down_ns))
        estimator.add(exchange)
        if k >= number // 2:
            error = estimator.offset_at(exchange.t3) - (clocks.rig(exchange.t3) - exchange.t3)
            errors.append(abs(error))
            held.append(abs(error) <= estimator.uncertainty_at(exchange.t3))
    assert estimator.steps == 0
    return max(errors), float(np.mean(held))


@settings(deadline=None, max_examples=20)
@given(st.integers(0, 2**32), st.floats(-80e-6, 80e-6), st.integers(-(10**12), 10**12))
def test_offset_recovered_under_asymmetric_jitter(seed: int, drift: float, offset_ns: int) -> None:
    # Ways differ: 1.5 ms of jitter up, 0.3 ms down; a hand at 1 m/s moves 0.5 mm in 0.5 ms.
    worst_ns, held = run(TrueClocks(EPOCH_NS + offset_ns, drift), np.random.default_rng(seed), 120, 1.5e6, 3e5)
    assert worst_ns < 500_000
    assert held == 1.0


def test_drift_is_recovered() -> None:
    clocks, rng, estimator = TrueClocks(EPOCH_NS, 40e-6), np.random.default_rng(3), ClockEstimator()
    for k in range(120):
        estimator.add(clocks.exchange(k * INTERVAL_NS, 2e5 + rng.exponential(1e5), 2e5 + rng.exponential(1e5)))
    assert estimator.drift_ppm == pytest.approx(40.0, abs=1.0)


def test_a_clock_that_was_set_is_followed_at_once() -> None:
    estimator = ClockEstimator()
    for k in range(20):
        estimator.add(TrueClocks(EPOCH_NS, 0.0).exchange(k * INTERVAL_NS, 3e5, 3e5))
    moved = TrueClocks(EPOCH_NS + 3_000_000_000, 0.0)
    exchange = moved.exchange(20 * INTERVAL_NS, 3e5, 3e5)
    estimator.add(exchange)
    assert estimator.steps == 1
    assert abs(estimator.offset_at(exchange.t3) - moved.offset_ns) < 1_000


def test_what_was_known_holds_until_another_clock_has_answered() -> None:
    """Capture reads it on a thread of its own, at any moment."""
    estimator = ClockEstimator()
    estimator.add(Exchange(0, 5_000, 5_000, 1_000))
    estimator.reset()
    assert estimator.offset_at(0) == 4_500
    estimator.add(Exchange(2_000, 9_000_000_000, 9_000_000_000, 3_000))
    assert estimator.offset_at(2_500) == 9_000_000_000 - 2_500
    assert estimator.steps == 0


def test_impossible_exchanges_are_not_believed() -> None:
    estimator = ClockEstimator()
    assert not estimator.add(Exchange(100, 5_000, 4_000, 200))
    assert not estimator.add(Exchange(100, 5_000, 9_000, 200))
    assert not estimator.ready


def test_uncertainty_grows_while_nobody_answers() -> None:
    estimator = ClockEstimator()
    estimator.add(TrueClocks(EPOCH_NS, 0.0).exchange(0, 3e5, 3e5))
    assert estimator.uncertainty_at(60 * 10**9) > estimator.uncertainty_at(10**9) + 1e6


def test_before_the_first_exchange_the_clock_says_so() -> None:
    clock = SyncedRigClock(SystemClock())
    assert not clock.ready
    assert clock.offset_ns is None
    with pytest.raises(BusError, match="is fusion running"):
        clock.now_ns()


def test_the_owner_maps_its_own_clock() -> None:
    node = SystemClock()
    clock = LocalRigClock(node)
    assert abs(clock.to_rig_ns(node.now_ns()) - clock.now_ns()) < 5_000_000


@pytest.mark.parametrize("interrupted", [(), (1,), (0, 1), (2, 4)])
def test_an_interruption_between_two_readings_moves_no_time(interrupted: tuple[int, ...]) -> None:
    """The process sleeps 3 ms before some of its readings; the clocks are 5 s apart, each reading takes 100 ns."""
    now_ns, readings = 1_000_000_000, 0

    def read(offset_ns: int) -> int:
        nonlocal now_ns, readings
        now_ns += 3_000_000 if readings in interrupted else 100
        readings += 1
        return now_ns + offset_ns

    assert difference_ns(lambda: read(5_000_000_000), lambda: read(0)) == pytest.approx(5_000_000_000, abs=1000)


def test_a_skewed_clock_is_off_as_asked() -> None:
    clock = SkewedClock(offset_ns=123_000_000, drift_ppm=50.0)
    origin = clock.now_ns()
    later = clock.from_true_ns(origin - 123_000_000 + 10**10)
    assert later - origin - 10**10 == pytest.approx(500_000, abs=20_000)


@pytest.mark.parametrize("seed", range(20))
def test_the_uncertainty_is_true_while_a_link_turns_slow(seed: int) -> None:
    """Ten seconds of a quick link teach a drift; then 20 ± 5 ms each way, unlike in the two directions."""
    rng = np.random.default_rng(seed)
    drift, offset_ns = rng.uniform(-100e-6, 100e-6), 5_000_000_000
    estimator = ClockEstimator()
    worst = 0.0
    for step in range(140):
        t0 = 1_000_000_000 + step * 500_000_000
        quick = step < 20
        there, back = rng.exponential(0.5e6, 2) + 0.1e6 if quick else rng.uniform(15e6, 25e6, 2)

        def rig(node_ns: float) -> int:
            return round(node_ns + offset_ns + drift * (node_ns - 1_000_000_000))

        t3 = t0 + round(there + back)
        estimator.add(Exchange(t0, rig(t0 + there), rig(t0 + there), t3))
        now = t3 + 400_000_000
        error_ns = abs(estimator.offset_at(now) - (rig(now) - now))
        worst = max(worst, error_ns / estimator.uncertainty_at(now))
    assert worst <= 1.0
    assert estimator.steps == 0
