"""Newest wins, and no faster than a browser takes."""

from __future__ import annotations

import json

import pytest

from rhot_viewer.grasp.newest import MOST_KEYS, Newest, Pace


def test_only_the_newest_of_what_has_changed_is_sent() -> None:
    newest = Newest()
    for number in range(5):
        newest.put("rhot/hand/right", str(number))
    newest.put("rhot/object/cup", "7")
    assert json.loads(newest.since(0))["keys"] == {"rhot/hand/right": 4, "rhot/object/cup": 7}
    version = newest.version
    assert newest.since(version) == ""
    newest.put("rhot/object/cup", "8")
    assert json.loads(newest.since(version))["keys"] == {"rhot/object/cup": 8}
    assert newest.since(version, without=("rhot/object/cup",)) == ""


def test_a_frame_tells_when_the_bus_handed_over_its_hand() -> None:
    newest = Newest()
    newest.put("rhot/space/stage", "1")
    assert "bus" not in json.loads(newest.since(0))
    newest.put("rhot/object/cup", "1", 1_700_000_000_001.25)
    assert json.loads(newest.since(0))["bus"] == 1_700_000_000_001.25
    newest.put("rhot/hand/right", "1", 1_700_000_000_000.5)
    newest.put("rhot/hand/left", "1", 1_700_000_000_000.75)
    assert json.loads(newest.since(0))["bus"] == 1_700_000_000_000.5, "no hand is older than it says"


def test_strangers_cannot_fill_the_table() -> None:
    newest = Newest()
    newest.put("rhot/hand/right", "1")
    for number in range(2 * MOST_KEYS):
        newest.put(f"rhot/object/{number}", "1")
        newest.put("rhot/object/cup", "1")
    keys = json.loads(newest.since(0))["keys"]
    assert len(keys) == MOST_KEYS + 1
    assert {"rhot/hand/right", "rhot/object/cup", f"rhot/object/{2 * MOST_KEYS - 1}"} <= keys.keys()


def test_a_browser_is_sent_no_more_than_it_wishes() -> None:
    pace = Pace(rate_hz=30.0)
    sent, now_s = 0, 0.0
    while now_s < 10.0:
        wait_s = pace.wait_s(now_s)
        if wait_s == 0.0:
            pace.sent(now_s, sent)
            pace.taken()
            sent += 1
        now_s += 0.001
    assert sent == pytest.approx(300, rel=0.02)


def test_a_browser_that_takes_nothing_is_sent_two_frames_and_no_more() -> None:
    pace = Pace()
    for _ in range(2):
        assert pace.wait_s(1e3) is not None
        pace.sent(1e3, 1)
    assert pace.wait_s(2e3) is None
    pace.ahead = 1
    pace.taken()
    assert pace.wait_s(2e3) is None, "who asks for each has one under way"
    pace.taken()
    assert pace.wait_s(2e3) == 0.0
