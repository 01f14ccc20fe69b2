"""What a busy machine excuses: a missed wall-clock limit and nothing else."""

from __future__ import annotations

import math

import pytest
from wall_clock import WallClockMissed, excuse, figures_in_time, in_time


def test_limits() -> None:
    in_time(1.9, 2.0, "end")
    figures_in_time([])
    with pytest.raises(WallClockMissed, match=r"end: 2.5 s, limit 2 s"):
        in_time(2.5, 2.0, "end")
    with pytest.raises(WallClockMissed):
        in_time(math.nan, 2.0, "end")
    with pytest.raises(WallClockMissed, match="rate 30 Hz; coverage"):
        figures_in_time(["rate 30 Hz", "coverage 0.9"])


@pytest.mark.parametrize("error", [AssertionError("wrong"), TimeoutError(), ValueError("x")])
def test_any_other_failure_fails_on_a_busy_machine(error: Exception) -> None:
    assert excuse(error, others=2.0) == ""


def test_a_missed_limit_fails_unless_others_used_the_machine() -> None:
    assert excuse(WallClockMissed("late"), others=0.1) == ""
    assert "late" in excuse(WallClockMissed("late"), others=0.5)
