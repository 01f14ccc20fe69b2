"""Constants that are chosen without the trial that is judged."""

from __future__ import annotations

import numpy as np
import pytest

from rhot_bench.steps.dead_reckoning import CANDIDATES, Reckoned, held_out_rows, kind_of, kind_rows


def trial(motion: str, best: int) -> Reckoned:
    """Return a recording at which one candidate is 10 mm off and all others 20 mm, at any speed."""
    error = np.full(len(CANDIDATES), 0.02)
    error[best] = 0.01
    return Reckoned(motion, 0.01, error, error)


def test_each_recording_is_judged_by_what_the_others_chose() -> None:
    rows = held_out_rows([trial("walk", 2), trial("walk", 4)], 1.6)
    assert rows[0].value == pytest.approx(20.0), "neither knows its own best"
    rows = held_out_rows([trial("walk", 2), trial("walk", 2), trial("walk", 2), trial("walk", 4)], 1.6)
    assert rows[0].value == pytest.approx((10.0 + 10.0 + 10.0 + 20.0) / 4.0)
    assert rows[1].value == pytest.approx(20.0)


def test_kinds_of_motion_are_compared_with_what_is_published_of_them() -> None:
    assert kind_of("run") == "running"
    assert kind_of("sensor lifted and moved slowly up to 0.9 m") == "moved by hand"
    rows = kind_rows(["walk", "slow walk", "run"], [10.0, 20.0, 90.0], [10.0, 20.0, 70.0])
    assert [(row.value, row.most) for row in rows] == [(90.0, 84.0), (90.0, None), (15.0, 18.0), (20.0, None)]
