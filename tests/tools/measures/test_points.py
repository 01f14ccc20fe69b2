from __future__ import annotations

import numpy as np
import pytest

from rhot_bench.hands.accuracy import survival
from rhot_tools.measures.points import PointTrack, false_points, identity_swaps, jitter_m

COUNT = 600


def standing(positions_off: np.ndarray | float = 0.0) -> PointTrack:
    """Three markers 10 cm apart, 0.8 m before the rig's origin."""
    true = np.tile(np.array([[-0.1, 0.0, 0.8], [0.0, 0.0, 0.8], [0.1, 0.0, 0.8]]), (COUNT, 1, 1))
    return PointTrack(
        ("thumb", "index", "middle"),
        np.arange(COUNT) / 60.0,
        true + positions_off,
        np.ones((COUNT, 3), dtype=bool),
        true,
        np.zeros((COUNT, 3)),
    )


def test_jitter_is_told_apart_by_direction() -> None:
    rng = np.random.default_rng(1)
    noise = rng.normal(0.0, (0.0002, 0.0002, 0.001), (COUNT, 3, 3))
    sideways, depth = jitter_m(standing(noise))
    # The outer two are looked at askew by 7°, which mixes a little depth noise in.
    assert sideways[1] * 1e3 == pytest.approx(0.2, rel=0.1)
    assert depth[1] * 1e3 == pytest.approx(1.0, rel=0.1)
    assert np.all(depth > 4.0 * sideways)


def test_errors_are_of_measured_points_alone() -> None:
    track = standing(np.array([0.0, 0.003, 0.004]))
    track.measured[::2, 0] = False
    errors = track.errors_m
    assert np.isnan(errors[::2, 0]).all()
    assert np.nanmedian(errors) == pytest.approx(0.005)


def test_swaps_count_stretches_and_false_points_count_points() -> None:
    track = standing()
    track.positions[100:130, (0, 1)] = track.positions[100:130, (1, 0)]
    track.positions[400, 2] = (0.3, 0.2, 0.9)
    assert identity_swaps(track) == 2
    assert false_points(track) == 1
    assert identity_swaps(standing()) == 0
    assert false_points(standing()) == 0
    track.measured[:] = False
    assert identity_swaps(track) == 0
    assert false_points(track) == 0


def test_survival_of_occlusions() -> None:
    track = standing()
    times_s = np.arange(0.0, 9.9, 1 / 30)
    visible = np.ones((len(times_s), 3), dtype=bool)
    visible[30:35] = False  # 0.17 s: bridged by prediction
    visible[90:95, 0] = False  # not bridged
    visible[150:200, 1] = False  # long
    track.measured[60:70] = False
    gone = (track.t_s > 3.0) & (track.t_s < 3.16)
    track.positions[gone, 0] = np.nan
    track.measured[gone, 0] = False
    result = survival(track, times_s, visible, 60.0)
    assert result.occlusions == 4
    assert result.survived == pytest.approx(0.75)
    assert result.measured == 1.0
    assert result.back_s == 0.0


def test_coverage_counts_what_was_seen_but_not_measured() -> None:
    track = standing()
    track.measured[:, 1] = False
    times_s = np.arange(0.0, 9.9, 1 / 30)
    result = survival(track, times_s, np.ones((len(times_s), 3), dtype=bool), 60.0)
    assert result.measured == pytest.approx(2 / 3)
    assert np.isnan(result.survived)
