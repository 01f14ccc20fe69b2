from __future__ import annotations

from rhot_capture.detection.track import MarkerTrack


def moving_track(frames: int = 3, step: float = 10.0) -> MarkerTrack:
    track = MarkerTrack()
    for frame in range(frames):
        track.update(100.0 + step * frame, 50.0, 200.0)
    return track


def test_without_a_track_all_positions_are_equal() -> None:
    assert MarkerTrack().preference(5.0, 5.0, 10.0) == 1.0


def test_the_predicted_position_is_preferred() -> None:
    track = moving_track()
    assert track.preference(130.0, 50.0, 200.0) == 1.0
    assert track.preference(130.0, 50.0, 200.0) > track.preference(90.0, 50.0, 200.0)


def test_nothing_is_excluded() -> None:
    assert moving_track().preference(630.0, 470.0, 2.0) > 0.0


def test_a_lost_marker_is_looked_for_ever_further_and_then_anywhere() -> None:
    track = moving_track(step=0.0)
    wide = []
    for _ in range(10):
        wide.append(track.preference(160.0, 50.0, 200.0))
        track.miss()
    assert wide == sorted(wide)
    assert track.preference(600.0, 400.0, 5.0) == 1.0


def test_motion_is_forgotten_across_a_gap() -> None:
    track = moving_track(step=40.0)
    track.miss()
    track.update(300.0, 50.0, 200.0)
    assert track.preference(300.0, 50.0, 200.0) == 1.0


def test_only_what_lies_where_the_marker_must_be_continues_it() -> None:
    track = moving_track()
    assert track.continues(132.0, 50.0)
    assert not track.continues(142.0, 50.0)
    for _ in range(3):
        track.miss()
    assert not track.continues(160.0, 50.0)
    assert not MarkerTrack().continues(0.0, 0.0)
