from __future__ import annotations

from itertools import pairwise

import pytest

from rhot_fusion.schedule import FrameSchedule

PERIOD = 1.0 / 60.0


def play(arrivals: list[tuple[int, float]], share: float, cameras: int = 2) -> list[float | None]:
    schedule = FrameSchedule([PERIOD] * cameras)
    moments = []
    for camera, t_s in arrivals:
        schedule.arrived(camera, t_s)
        moments.append(schedule.moment(share))
    return moments


def test_cameras_in_step_are_waited_for() -> None:
    arrivals = [(camera, number * PERIOD) for number in range(10) for camera in (0, 1)]
    moments = play(arrivals, 0.6)
    # The first camera's first frame knows of no other camera yet.
    assert moments[2::2] == [None] * 9
    assert moments[3::2] == pytest.approx([number * PERIOD for number in range(1, 10)])


def test_lost_frames_of_both_do_not_end_the_wait() -> None:
    arrivals = [(camera, number * PERIOD) for number in (0, 1, 2, 3, 6, 7, 12, 13) for camera in (0, 1)]
    moments = play(arrivals, 0.6)
    assert moments[2::2] == [None] * 7
    assert None not in moments[3::2]


def test_camera_that_fell_silent_is_not_waited_for_twice() -> None:
    arrivals = [(0, 0.0), (1, 0.0), (0, PERIOD), (0, 2 * PERIOD), (0, 3 * PERIOD)]
    moments = play(arrivals, 0.6)
    assert moments[2] is None
    assert moments[3] == pytest.approx(2 * PERIOD)
    assert moments[4] == pytest.approx(3 * PERIOD)


def test_unsynchronised_cameras_are_extrapolated_within_limits() -> None:
    arrivals = sorted(
        [(0, n * PERIOD) for n in range(8)] + [(1, n * PERIOD + 0.007) for n in range(8)], key=lambda one: one[1]
    )
    late = play(arrivals, 0.6)[4:]
    # 9.7 ms and 7 ms lie within 0.6 · 16.7 ms = 10 ms: every set is as new as its frame.
    assert late == pytest.approx([t_s for _, t_s in arrivals[4:]])
    bounded = play(arrivals, 0.5)[4:]
    for (camera, t_s), moment in zip(arrivals[4:], bounded, strict=True):
        # The other camera's frame lies 9.7 ms before camera 0's and may be extrapolated by 8.3 ms.
        expected = t_s if camera == 1 else t_s - (PERIOD - 0.007) + 0.5 * PERIOD
        assert moment == pytest.approx(expected)


def test_without_extrapolation_the_older_camera_sets_the_moment() -> None:
    arrivals = sorted(
        [(0, n * PERIOD) for n in range(6)] + [(1, n * PERIOD + 0.007) for n in range(6)], key=lambda one: one[1]
    )
    moments = play(arrivals, 0.0)[4:]
    assert moments == pytest.approx([t_s for _, t_s in arrivals[3:-1]])


def test_moments_increase_strictly_whatever_the_order_of_arrival() -> None:
    arrivals = [(0, 0.0), (1, 0.02), (1, 0.037), (0, 0.0167), (0, 0.033), (1, 0.054), (0, 0.05)]
    moments = [moment for moment in play(arrivals, 0.6) if moment is not None]
    assert all(a < b for a, b in pairwise(moments))


def test_period_is_the_median_interval() -> None:
    schedule = FrameSchedule([PERIOD])
    for number in (0, 1, 2, 5, 6, 7, 8):
        schedule.arrived(0, number / 30.0)
    assert schedule.period_s(0) == pytest.approx(1.0 / 30.0)
    schedule.clear()
    assert schedule.period_s(0) == PERIOD
    assert schedule.moment(0.6) is None
