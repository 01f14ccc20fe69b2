"""Wire messages: exact encoding, round trips, refusals."""

from __future__ import annotations

import json
import math
from typing import Any

import msgpack
import pytest
from hand_messages import hand_pose, marker_frame, point_set
from hypothesis import given
from hypothesis import strategies as st
from pydantic import ValidationError

from rhot.errors import WireError
from rhot.messages import (
    Control,
    HandPose,
    Joint,
    Marker,
    MarkerFrame,
    ObjectPose,
    Point,
    PointSet,
    decode,
    encode,
    encoding_of,
)

FRAME = MarkerFrame(
    t_ns=1_790_000_000_123_456_789,
    seq=7,
    camera="left",
    width=640,
    height=480,
    markers={"thumb": Marker(u=12.25, v=-0.5, area=80.0, score=0.9, corners=((0, 0), (1, 0), (1, 1), (0, 1)))},
    timing={"classify": 0.001},
)

times = st.integers(0, 2**62 - 1)
pixels = st.floats(-1e5, 1e5, allow_nan=False)
metres = st.floats(-1e3, 1e3, allow_nan=False)
names = st.text("abcdefghijklmnopqrstuvwxyzABC0123456789_-.", min_size=1, max_size=12)
markers = st.builds(Marker, u=pixels, v=pixels, area=st.floats(0, 1e9), score=st.floats(0, 1), t_ns=st.none() | times)
frames = st.builds(
    MarkerFrame,
    t_ns=times,
    seq=times,
    camera=names,
    width=st.integers(1, 65536),
    height=st.integers(1, 65536),
    markers=st.dictionaries(names, markers, max_size=6),
)
points = st.builds(
    Point,
    position=st.tuples(metres, metres, metres),
    sigma=st.floats(0, 1e3),
    views=st.integers(0, 8),
    state=st.sampled_from(["measured", "predicted"]),
)
point_sets = st.builds(PointSet, t_ns=times, seq=times, frame=st.just("rig"), points=st.dictionaries(names, points))


@given(st.one_of(frames, point_sets))
def test_round_trip_keeps_everything(message: MarkerFrame | PointSet) -> None:
    assert decode(encode(message), type(message)) == message


def test_payload_is_a_plain_msgpack_map_with_the_documented_names() -> None:
    plain = msgpack.unpackb(encode(FRAME))
    assert plain["camera"] == "left"
    assert plain["t_ns"] == 1_790_000_000_123_456_789
    assert plain["markers"]["thumb"]["u"] == 12.25
    assert "outline" not in plain["markers"]["thumb"], "fields that are None are left out"
    assert encoding_of(MarkerFrame) == "application/msgpack;MarkerFrame"


def test_unknown_fields_are_ignored() -> None:
    plain = msgpack.unpackb(encode(FRAME)) | {"from_the_future": [1, 2]}
    assert decode(msgpack.packb(plain), MarkerFrame) == FRAME


def _changed(**changes: Any) -> bytes:
    packed: bytes = msgpack.packb(msgpack.unpackb(encode(FRAME)) | changes)
    return packed


@pytest.mark.parametrize(
    ("payload", "names"),
    [
        (_changed(t_ns="soon"), "t_ns"),
        (_changed(t_ns=-1), "t_ns"),
        (_changed(t_ns=1.5), "t_ns"),
        (_changed(camera="a/b"), "camera"),
        (_changed(camera=None), "camera"),
        (_changed(width=0), "width"),
        (_changed(markers={"thumb": {"u": math.nan, "v": 0.0, "area": 1.0, "score": 1.0}}), "markers.thumb.u"),
        (_changed(markers={"thumb": {"u": 1e300, "v": 0.0, "area": 1.0, "score": 1.0}}), "markers.thumb.u"),
        (_changed(markers={"thumb": {"u": 1.0, "v": 0.0, "area": 1.0, "score": 2.0}}), "markers.thumb.score"),
        (_changed(markers={"thumb": {"u": 1.0}}), "markers.thumb.v"),
        (_changed(markers=[1, 2]), "markers"),
        (_changed(schema_version=2), "schema_version"),
        (b"", "msgpack"),
        (b"\x05", "MarkerFrame"),
        (b"\xc1", "msgpack"),
        (encode(FRAME)[:-3], "msgpack"),
        (encode(FRAME) + b"\x00", "msgpack"),
        (b"\x91" * 3000, "msgpack"),
        (bytes(2 << 20), "limit"),
    ],
)
def test_what_is_wrong_is_refused_and_named(payload: bytes, names: str) -> None:
    with pytest.raises(WireError, match=names):
        decode(payload, MarkerFrame)


@given(st.binary(max_size=400))
def test_random_bytes_only_ever_raise_a_wire_error(payload: bytes) -> None:
    for model in (MarkerFrame, PointSet, HandPose, Control):
        with pytest.raises(WireError):
            decode(payload, model)


@given(st.integers(0, 200), st.integers(0, 255))
def test_a_flipped_byte_is_refused_or_still_a_valid_frame(position: int, value: int) -> None:
    payload = bytearray(encode(FRAME))
    payload[position % len(payload)] = value
    try:
        frame = decode(bytes(payload), MarkerFrame)
    except WireError:
        return
    assert all(math.isfinite(marker.u) and abs(marker.u) <= 1e5 for marker in frame.markers.values())


def test_quaternions_must_have_unit_norm() -> None:
    with pytest.raises(ValueError, match="norm 2"):
        Joint(position=(0.0, 0.0, 0.0), orientation=(0.0, 0.0, 0.0, 2.0), radius=0.01)
    pose = ObjectPose(t_ns=1, frame="rig", position=(0.0, 0.0, 1.0), orientation=(0.0, 0.6, 0.0, 0.8), state="measured")
    assert decode(encode(pose), ObjectPose) == pose


def test_what_json_lines_hold_is_valid_as_it_is_read() -> None:
    """JSON and msgpack know lists only; the numbers in them stay strict."""
    for message in (hand_pose(0.1, 10), marker_frame("left", 10), point_set(10)):
        value = json.loads(message.model_dump_json(exclude_none=True))
        assert type(message).model_validate(value) == message
    value["points"]["index"]["position"][0] = "0.1"
    with pytest.raises(ValidationError, match="valid number"):
        PointSet.model_validate(value)
