from __future__ import annotations

import numpy as np
import pytest

from rhot_fusion.views.epipolar import Tracks

ONE = np.array([0])
FAST = 100.0


def filled(times: list[float], x: list[float], max_rate: float = FAST) -> Tracks:
    tracks = Tracks(2, 2)
    for t_s, value in zip(times, x, strict=True):
        tracks.append(0, ONE, np.array([t_s]), np.array([[value, -value]]), max_rate)
    return tracks


def test_between_observations_a_track_is_interpolated() -> None:
    shot = filled([0.0, 0.02], [0.1, 0.3]).at(0.005, 0.01, 0.1)
    np.testing.assert_allclose(shot.xy[0, 0], [0.15, -0.15])
    assert shot.valid.tolist() == [[True, False], [False, False]]
    assert np.isnan(shot.xy[1]).all()


def test_at_its_own_time_an_observation_is_itself() -> None:
    shot = filled([0.0, 0.02, 0.04], [0.1, 0.3, 0.2]).at(0.04, 0.01, 0.1)
    np.testing.assert_array_equal(shot.xy[0, 0], [0.2, -0.2])


def test_steady_motion_is_extrapolated_exactly_and_for_a_bounded_time() -> None:
    tracks = filled([0.0, 0.02, 0.04], [0.1, 0.2, 0.3])
    np.testing.assert_allclose(tracks.at(0.05, 0.011, 0.1).xy[0, 0], [0.35, -0.35])
    assert not tracks.at(0.052, 0.011, 0.1).valid.any()


def test_acceleration_is_followed_by_half() -> None:
    times = [0.0, 0.02, 0.04]
    tracks = filled(times, [50.0 * t**2 for t in times])
    straight = 50.0 * 0.04**2 + 50.0 * (0.04**2 - 0.02**2) / 0.02 * 0.01
    assert tracks.at(0.05, 0.02, 0.1).xy[0, 0, 0] == pytest.approx(0.5 * (straight + 50.0 * 0.05**2))


def test_jump_cuts_the_track() -> None:
    tracks = filled([0.0, 0.02, 0.04], [0.1, 0.1, 0.9], max_rate=10.0)
    # Neither interpolated nor extrapolated with the jump's speed.
    assert not tracks.at(0.03, 0.01, 0.1).valid.any()
    np.testing.assert_allclose(tracks.at(0.05, 0.011, 0.1).xy[0, 0], [0.9, -0.9])
    np.testing.assert_allclose(tracks.at(0.01, 0.01, 0.1).xy[0, 0], [0.1, -0.1])


def test_gap_is_not_interpolated_across() -> None:
    tracks = filled([0.0, 0.5], [0.1, 0.2])
    assert not tracks.at(0.3, 0.01, 0.1).valid.any()


def test_before_the_history_there_is_nothing() -> None:
    assert not filled([1.0, 1.02], [0.1, 0.2]).at(0.9, 0.01, 0.1).valid.any()


def test_clear_forgets() -> None:
    tracks = filled([0.0, 0.02], [0.1, 0.3])
    tracks.clear()
    assert not tracks.at(0.02, 0.01, 0.1).valid.any()
    assert (tracks.last_t_s == -np.inf).all()
