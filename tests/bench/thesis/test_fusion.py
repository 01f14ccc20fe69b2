from __future__ import annotations

import numpy as np
import pytest

from rhot_bench.thesis.hand import Arrival, OneEuro, ThesisFusion, law_depth_m


def test_the_law_fits_the_distances_that_it_was_made_for() -> None:
    for distance_cm, disparity in ((20, 189), (40, 97), (60, 66), (100, 40)):
        assert law_depth_m(disparity) * 100 == pytest.approx(distance_cm, rel=0.015)
    assert law_depth_m(-97) == law_depth_m(97)


def test_frames_pair_within_twenty_milliseconds_only() -> None:
    fusion = ThesisFusion(530.0, (319.5, 239.5))
    assert fusion.feed("left", Arrival(1.000, {"index": (360.0, 240.0)})) == {}
    points = fusion.feed("right", Arrival(1.015, {"index": (310.0, 240.0), "thumb": (1.0, 2.0)}))
    assert set(points) == {"index"}
    x, _, z = points["index"]
    assert z == pytest.approx(law_depth_m(50.0))
    assert x == pytest.approx(z * 40.5 / 530.0)
    assert fusion.feed("left", Arrival(1.060, {"index": (360.0, 240.0)})) == {}


def test_the_filter_smooths_rest_and_lags_motion() -> None:
    rng = np.random.default_rng(0)
    rest, noise = OneEuro(), rng.normal(0.0, 0.01, 600)
    smoothed = [rest.smooth(k / 30.0, float(value)) for k, value in enumerate(noise)]
    assert np.std(smoothed[100:]) < 0.5 * np.std(noise)
    moving = OneEuro()
    last = [moving.smooth(k / 30.0, k / 30.0) for k in range(90)][-1]
    assert last < 89 / 30.0 - 0.05
