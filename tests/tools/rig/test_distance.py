"""The error of a known distance between two markers, from points whose errors are known."""

from __future__ import annotations

import numpy as np
import pytest

from rhot.errors import ConfigError
from rhot.messages import Point, PointSet, Truth
from rhot_tools.rig.command import distance_section, distances
from rhot_tools.rig.heard import Heard

START_NS = 1_700_000_000_000_000_000
PAIR = ("thumb", "pinky")


def moved(scale: float = 1.0, noise_m: float = 1e-3, length_m: float = 0.2, count: int = 1200) -> Heard:
    """A rod that turns and wanders through 0.4 m x 0.3 m x 0.2 m; white noise on both markers, which state it."""
    rng, heard = np.random.default_rng(5), Heard()
    covariance = (noise_m**2, 0.0, 0.0, noise_m**2, 0.0, noise_m**2)
    for number in range(count):
        t_s = number / 60.0
        middle = np.array([0.2 * np.sin(t_s), 0.15 * np.sin(1.3 * t_s), 0.6 + 0.1 * np.sin(0.7 * t_s)])
        half = 0.5 * length_m * np.array([np.cos(t_s), np.sin(t_s), 0.0])
        points = {}
        for name, place in zip(PAIR, (middle + half, middle - half), strict=True):
            x, y, z = scale * place + rng.normal(0.0, noise_m, 3)
            points[name] = Point(position=(x, y, z), sigma=noise_m, covariance=covariance, views=2, state="measured")
        heard.note("rhot/points", PointSet(t_ns=START_NS + number * 16_666_667, frame="rig", points=points))
    return heard


def test_white_noise_gives_its_own_size_and_an_honest_sigma() -> None:
    found = {row.name: row for row in distance_section(distances(moved(), PAIR, 0.2), PAIR).rows}
    quoted = found["error of the distance, RMS"]
    assert quoted.value == pytest.approx(np.sqrt(2.0), rel=0.06)
    assert "to quote; in a volume of 39" in quoted.note
    assert "95 %" in quoted.note
    assert found["error over stated sigma, RMS"].value == pytest.approx(1.0, rel=0.06)
    assert found["both markers measured"].value == 100.0


def test_a_wrong_scale_is_the_mean() -> None:
    found = {row.name: row for row in distance_section(distances(moved(1.02, 1e-5), PAIR, 0.2), PAIR).rows}
    assert found["error of the distance, mean"].value == pytest.approx(4.0, abs=0.01)
    assert found["error of the distance, RMS"].value == pytest.approx(4.0, abs=0.01)


def test_a_simulated_rig_knows_the_distance_at_each_moment() -> None:
    heard = moved(noise_m=1e-5)
    for points in heard.points:
        places = {name: point.position for name, point in points.points.items()}
        heard.truth.append(Truth(t_ns=points.t_ns, frame="rig", points=places, hands={}, objects={}))
    assert np.abs(distances(heard, PAIR, None).error_m).max() < 1e-9


def test_what_is_missing_is_named() -> None:
    with pytest.raises(ConfigError, match="--length-mm is missing"):
        distances(moved(), PAIR, None)
    with pytest.raises(ConfigError, match="measured together 99 times"):
        distances(moved(count=99), PAIR, 0.2)
