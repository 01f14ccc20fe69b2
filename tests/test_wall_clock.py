"""What a busy or a slow machine excuses: a missed wall-clock limit and nothing else."""

from __future__ import annotations

import math

import pytest
from wall_clock import WallClockMissed, excuse, figures_in_time, in_time


def test_limits() -> None:
    in_time(1.9, 2.0, "end")
    figures_in_time({})
    with pytest.raises(WallClockMissed, match=r"end: 2.5 s, limit 2 s"):
        in_time(2.5, 2.0, "end")
    with pytest.raises(WallClockMissed):
        in_time(math.nan, 2.0, "end")
    with pytest.raises(WallClockMissed, match="rate 30 Hz; coverage"):
        figures_in_time({"rate 30 Hz": 1.8, "coverage 0.9": math.inf})


@pytest.mark.parametrize("error", [AssertionError("wrong"), TimeoutError(), ValueError("x")])
def test_any_other_failure_fails_on_a_busy_and_slow_machine(error: Exception) -> None:
    assert excuse(error, others=2.0, slowness=3.0) == ""


def test_a_missed_limit_fails_unless_others_used_the_machine() -> None:
    assert excuse(WallClockMissed("late", 2.0), others=0.1, slowness=1.0) == ""
    assert "late" in excuse(WallClockMissed("late", 2.0), others=0.5, slowness=1.0)


def test_a_slow_machine_may_take_as_many_times_as_long() -> None:
    with pytest.raises(WallClockMissed) as late:
        in_time(45.0, 30.0, "latency", "ms")
    assert excuse(late.value, others=0.0, slowness=1.4) == ""
    assert "takes 1.7 times as long" in excuse(late.value, others=0.0, slowness=1.7)
    with pytest.raises(WallClockMissed) as lost:
        figures_in_time({"latency": 1.5, "a frame lost": math.inf})
    assert excuse(lost.value, others=0.0, slowness=9.0) == ""
