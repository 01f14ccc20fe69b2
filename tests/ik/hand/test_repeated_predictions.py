"""What fusion guesses again and again counts less each time; what cameras see counts in full."""

from __future__ import annotations

import numpy as np
import pytest

from rhot.messages import Point, PointState
from rhot_ik.hand_core import RepeatedPredictions

RAY = np.array([0.6, 0.0, 0.8])
ALONG_M, ACROSS_M = 0.08, 0.002


def point(state: PointState) -> Point:
    C = ACROSS_M**2 * np.eye(3) + (ALONG_M**2 - ACROSS_M**2) * np.outer(RAY, RAY)
    covariance = (C[0, 0], C[0, 1], C[0, 2], C[1, 1], C[1, 2], C[2, 2])
    return Point(position=(0.0, 0.0, 0.7), sigma=ALONG_M, views=1, state=state, covariance=covariance)


def sigmas(guesses: RepeatedPredictions, told: Point) -> tuple[float, float]:
    C = np.array(guesses.covariance("ring", told)).reshape(3, 3)
    side = np.array([0.0, 1.0, 0.0])
    return float(np.sqrt(RAY @ C @ RAY)), float(np.sqrt(side @ C @ side))


def test_measured_points_count_in_full() -> None:
    guesses = RepeatedPredictions()
    for _ in range(3):
        assert sigmas(guesses, point("measured")) == pytest.approx((ALONG_M, ACROSS_M))


@pytest.mark.parametrize("guess", ["one_view", "predicted"])
def test_guesses_count_less_each_time_in_all_directions_until_both_cameras_see_the_marker(guess: PointState) -> None:
    guesses = RepeatedPredictions()
    for _ in range(3):
        for k in range(1, 5):
            assert sigmas(guesses, point(guess)) == pytest.approx((ALONG_M * k**0.5, ACROSS_M * k**0.5))
        sigmas(guesses, point("measured"))


def test_what_two_cameras_see_badly_is_no_guess() -> None:
    guesses, told = RepeatedPredictions(), point("predicted").model_copy(update={"views": 2})
    for _ in range(3):
        assert sigmas(guesses, told) == pytest.approx((ALONG_M, ACROSS_M))


def test_a_point_without_covariance_is_alike_in_all_directions() -> None:
    told = Point(position=(0.0, 0.0, 0.7), sigma=0.003, views=2, state="measured")
    assert np.allclose(RepeatedPredictions().covariance("ring", told), (0.003**2 / 3.0 * np.eye(3)).reshape(9))
