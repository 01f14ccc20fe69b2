"""Losses are counted from the publishers' own numbers."""

from __future__ import annotations

import msgpack
import pytest
from hand_messages import hand_pose

from rhot.messages import encode, with_seq
from rhot.recording.mcap.gaps import MOST_ENCODINGS_OF_A_KEY, MOST_KEYS_OF_A_KIND, Tally, peek


def test_skipped_numbers_are_losses_and_a_new_beginning_is_none() -> None:
    tally = Tally()
    for seq in (5, 6, 9, 10, 0, 1, 3):
        tally.note("rhot/points", seq, 10)
    tally.note("rhot/config/fusion/main", None, 7)
    count = tally.keys["rhot/points"]
    assert (count.messages, count.lost, count.restarts, count.bytes) == (7, 3, 1, 70)
    assert (tally.messages, tally.lost) == (8, 3)


def test_another_publishers_numbers_are_no_losses() -> None:
    tally = Tally()
    for seq in (5, 6, 2**62, 7, 8):
        tally.note("rhot/points", seq, 10)
    assert tally.lost == 0


def test_invented_keys_and_encodings_are_bounded_and_shut_out_no_others() -> None:
    tally = Tally()
    admitted = sum(tally.admits(f"rhot/x/{n}", "a/b") for n in range(70_000))
    assert (admitted, tally.left_out) == (MOST_KEYS_OF_A_KIND, 70_000 - MOST_KEYS_OF_A_KIND)
    assert tally.admits("rhot/hand/right", "a/b")
    assert sum(tally.admits("rhot/hand/right", f"a/{n}") for n in range(1000)) == MOST_ENCODINGS_OF_A_KEY - 1
    assert tally.admits("rhot/hand/right", "a/b")
    assert sum(tally.admits(f"rhot/{n}/x", "a/b") for n in range(1000)) < 64
    assert not tally.admits(f"rhot/hand/{'x' * 600}", "a/b")


def test_time_and_number_are_read_without_the_rest() -> None:
    assert peek(encode(with_seq(hand_pose(0.0, 1234), 56))) == (1234, 56)
    assert peek(msgpack.packb({"x": [1, {"y": 2}], "seq": 3, "t_ns": 4})) == (4, 3)


@pytest.mark.parametrize(
    "payload",
    [
        b"",
        b"\xc1",
        b"\x82\xa4t_ns",
        b"not msgpack",
        msgpack.packb([1, 2]),
        msgpack.packb({"t_ns": -1, "seq": True}),
        msgpack.packb({"t_ns": "now", "seq": 2**63}),
        msgpack.packb({1: 2}),
    ],
)
def test_garbage_has_neither(payload: bytes) -> None:
    assert peek(payload) == (None, None)


def test_two_publishers_of_a_key_are_told_from_losses() -> None:
    tally = Tally()
    for number in range(100):
        tally.note("rhot/points", 5000 + number, 1)
        tally.note("rhot/points", number, 1)
    count = tally.keys["rhot/points"]
    assert (count.lost, count.restarts, count.shared) == (0, 1, True)


def test_a_publisher_that_was_restarted_is_no_second_one() -> None:
    tally = Tally()
    for seq in (*range(50), *range(100), 103, *range(104, 200)):
        tally.note("rhot/points", seq, 1)
    count = tally.keys["rhot/points"]
    assert (count.lost, count.restarts, count.shared) == (3, 1, False)
