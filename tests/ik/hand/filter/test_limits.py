from __future__ import annotations

import numpy as np
import pytest

from rhot_ik.hand.filter.filter import within_limits
from rhot_ik.hand.filter.process import ANGLES, SIZE

LOW, HIGH = np.full(20, -10.0), np.full(20, 10.0)
FIRST, SECOND = ANGLES.start, ANGLES.start + 1


@pytest.mark.parametrize("beyond", [0.0, 0.5, 1.0, 2.0, 3.0])
def test_an_angle_at_its_limit_keeps_what_is_left_of_its_distribution_inside(beyond: float) -> None:
    P = np.eye(SIZE)
    dx = np.zeros(SIZE)
    dx[FIRST] = 10.0 + beyond + 1e-5
    inside = np.random.default_rng(1).normal(beyond, 1.0, 2_000_000)
    inside = inside[inside < 0.0]
    dx, P = within_limits(dx, P, np.zeros(20), LOW, HIGH)
    assert dx[FIRST] == pytest.approx(10.0, abs=1e-4)
    assert P[FIRST, FIRST] == pytest.approx(float((inside * inside).mean()), rel=0.1)


def test_others_move_by_what_the_limits_say_and_p_stays_a_covariance() -> None:
    rng = np.random.default_rng(2)
    A = rng.normal(0.0, 1.0, (SIZE, SIZE))
    before = A @ A.T
    dx = np.zeros(SIZE)
    dx[FIRST], dx[SECOND], dx[SECOND + 1] = 15.0, -18.0, 16.0
    for count in (1, 2, 3):
        off = np.zeros(SIZE)
        off[FIRST : FIRST + count] = dx[FIRST : FIRST + count]
        found, P = within_limits(off, before, np.zeros(20), LOW, HIGH)
        assert np.abs(found[ANGLES]).max() < 10.0 + 1e-3
        assert np.abs(found[:12]).max() > 0.01
        assert np.linalg.eigvalsh(P).min() > 0.0
        assert np.linalg.eigvalsh(before - P).min() > -1e-9


def test_what_is_inside_stays() -> None:
    dx = np.full(SIZE, 0.5)
    found, P = within_limits(dx, np.eye(SIZE), np.zeros(20), LOW, HIGH)
    assert np.array_equal(found, dx)
    assert np.array_equal(P, np.eye(SIZE))
