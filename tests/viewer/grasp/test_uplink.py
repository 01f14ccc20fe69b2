"""What a browser may tell, and where its headset is in the rig."""

from __future__ import annotations

import json

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from rhot.errors import WireError
from rhot.geometry.rotations import quaternion_from_rotation, rigid, rotation_from_quaternion, rotation_from_vector
from rhot_viewer.grasp.uplink import (
    MOST_BYTES,
    Devices,
    DrawingFigures,
    Preferences,
    controller_pose,
    head_pose,
    parse_message,
)

POSE = {"position": [0.1, 1.2, -0.3], "orientation": [0.0, 0.6, 0.0, 0.8]}


def test_a_headset_tells_where_it_is() -> None:
    message = parse_message(json.dumps({"type": "devices", "t_ms": 1.7e12, "head": POSE, "controller": POSE}))
    assert isinstance(message, Devices)
    assert message.head is not None
    T = rigid(rotation_from_vector(np.array([0.3, -1.0, 0.5])), np.array([0.2, -0.1, 0.9]))
    head, controller = (
        head_pose(message.head, message.t_ms, T),
        controller_pose(message.head, message.t_ms, T),
    )
    expected = T @ rigid(rotation_from_quaternion(np.array(POSE["orientation"])), np.array(POSE["position"]))
    for pose in (head, controller):
        assert pose.position == pytest.approx(expected[:3, 3], abs=1e-12)
        q = np.array(pose.orientation)
        assert abs(q @ quaternion_from_rotation(expected[:3, :3])) == pytest.approx(1.0, abs=1e-12)
        assert pose.t_ns == 1_700_000_000_000_000_000
        assert pose.frame == "rig"


def test_a_browser_tells_what_it_has_drawn() -> None:
    message = parse_message('{"type":"shown","pictures_hz":59.9,"waits_ms":[3.1,17],"clock_ms":0.3,"graphics":true}')
    assert message == DrawingFigures(type="shown", pictures_hz=59.9, waits_ms=[3.1, 17.0], clock_ms=0.3, graphics=True)
    longest = {"type": "shown", "pictures_hz": 240.0, "waits_ms": [123.45] * 240, "clock_ms": 1.25, "graphics": False}
    text = json.dumps(longest, separators=(",", ":"))
    assert parse_message(text)
    assert len(text) < MOST_BYTES


@pytest.mark.parametrize(
    "bad",
    [
        '{"type": "wish", "ahead": 3}',
        '{"type": "shown", "pictures_hz": 60, "waits_ms": [1e9], "clock_ms": 0, "graphics": true}',
        json.dumps({"type": "shown", "pictures_hz": 1, "waits_ms": [1] * 241, "clock_ms": 0, "graphics": True}),
        "",
        "[]",
        "null",
        "\x00",
        '{"type": "publish"}',
        '{"type": "wish", "rate_hz": 1e9}',
        '{"type": "wish", "rate_hz": 0}',
        '{"type": "taken", "more": 1}',
        '{"type": "time", "at_ms": NaN}',
        json.dumps({"type": "devices", "t_ms": 1.0, "head": {**POSE, "orientation": [0, 0, 0, 2]}}),
        json.dumps({"type": "devices", "t_ms": 1.0, "head": {**POSE, "position": [1e9, 0, 0]}}),
        json.dumps({"type": "devices", "t_ms": -1.0, "head": POSE}),
        json.dumps({"type": "devices", "t_ms": 1e300, "head": POSE}),
        json.dumps({"type": "devices", "t_ms": "1", "head": POSE}),
    ],
)
def test_garbage_is_refused(bad: str) -> None:
    with pytest.raises(WireError):
        parse_message(bad)


@given(st.binary(max_size=200))
def test_any_bytes_are_refused_or_understood(data: bytes) -> None:
    try:
        parse_message(data)
    except WireError:
        return


def test_a_wish_may_leave_things_out() -> None:
    assert parse_message('{"type": "wish"}') == Preferences(type="wish")
