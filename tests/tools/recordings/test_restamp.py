"""Recorded times moved to now: nothing but times changes, and all times by the same map."""

from __future__ import annotations

import numpy as np
import pytest
from hand_messages import hand_pose, marker_frame

from rhot.messages import Control, MarkerFrame, Message, ServiceStatus, decode, encode, encoding_of
from rhot.recording.mcap.reader import RecordedSample
from rhot_tools.recordings.restamp import Restamp, clock_skew_ns, with_times

T_NS = 1_700_000_000_000_000_000
NOW_NS = 1_800_000_000_000_000_000


def sample(message: Message, log_ns: int) -> RecordedSample:
    return RecordedSample("rhot/x", encoding_of(type(message)), encode(message), message.t_ns, log_ns)


class Clock:
    now_ns = NOW_NS

    def __call__(self) -> int:
        return self.now_ns


@pytest.mark.parametrize("message", [marker_frame("left", T_NS), hand_pose(0.3, T_NS)])
def test_only_times_change(message: Message) -> None:
    recorded = sample(message, T_NS + 5_000_000)
    assert with_times(recorded, lambda t_ns: t_ns).payload == recorded.payload
    moved = with_times(recorded, lambda t_ns: t_ns + 7)
    assert moved.t_ns == T_NS + 7
    same = decode(moved.payload, type(message)).model_dump()
    assert same.pop("t_ns") == T_NS + 7
    if isinstance(message, MarkerFrame):
        assert {marker["t_ns"] for marker in same["markers"].values()} == {T_NS + 1_000_007}
        for name, marker in same["markers"].items():
            marker["t_ns"] = message.markers[name].t_ns
    assert same == {name: value for name, value in message.model_dump().items() if name != "t_ns"}


@pytest.mark.parametrize("rate", [0.5, 1.0, 4.0])
def test_messages_are_as_old_and_as_far_apart_as_they_were(rate: float) -> None:
    clock = Clock()
    restamp = Restamp(rate, 0, clock)
    times = []
    for step, late_ns in enumerate((0, 900_000, 300_000)):
        clock.now_ns = NOW_NS + round(step * 16_000_000 / rate) + late_ns
        frame = marker_frame("left", T_NS + step * 16_000_000)
        times.append(restamp(sample(frame, frame.t_ns + 8_000_000)).t_ns)
    assert times[0] == NOW_NS - round(8_000_000 / rate)
    assert np.diff(times).tolist() == [16_000_000 / rate] * 2


def test_the_times_of_a_recorder_that_is_off_are_taken_as_now() -> None:
    behind_ns = 3600 * 10**9
    frames = [marker_frame("left", T_NS + step * 16_000_000) for step in range(40)]
    samples = [sample(frame, frame.t_ns - behind_ns + 4_000_000) for frame in frames]
    samples[7] = sample(frames[7].model_copy(update={"t_ns": 1}), samples[7].log_ns)
    skew_ns = clock_skew_ns(samples)
    assert skew_ns == -behind_ns + 4_000_000
    assert Restamp(1.0, skew_ns, Clock())(samples[0]).t_ns == NOW_NS
    assert clock_skew_ns([sample(frame, frame.t_ns + 4_000_000) for frame in frames]) == 0
    assert clock_skew_ns([]) == 0


def test_a_second_pass_and_a_stall_begin_at_now() -> None:
    clock = Clock()
    restamp = Restamp(1.0, 0, clock)
    first = sample(marker_frame("left", T_NS), T_NS)
    restamp(first)
    clock.now_ns += 60 * 10**9
    assert restamp(first).t_ns == clock.now_ns, "once more from the beginning"
    clock.now_ns += 2 * 10**9
    later = sample(marker_frame("left", T_NS + 10**9), T_NS + 10**9)
    assert restamp(later).t_ns == clock.now_ns, "a second late is too late to be believed"


def test_what_is_no_message_stays_as_it_is() -> None:
    text = RecordedSample("rhot/config/x/y", "application/json", b'{"t_ns": 5}', 3, 3)
    broken = RecordedSample("rhot/x", "application/msgpack;PointSet", b"\xc1", 3, 3)
    number = RecordedSample("rhot/x", "application/msgpack", b"\x05", 3, 3)
    for odd in (text, broken, number):
        assert Restamp(1.0, 0, Clock())(odd) == odd
    waiting = ServiceStatus(t_ns=0, service="ik", instance="main", state="waiting")
    assert decode(Restamp(1.0, 0, Clock())(sample(waiting, T_NS)).payload, ServiceStatus).t_ns == 0
    start = Control(t_ns=T_NS, action="start", session="s", start_t_ns=T_NS + 10**9)
    moved = decode(Restamp(1.0, 0, Clock())(sample(start, T_NS)).payload, Control)
    assert moved.start_t_ns - moved.t_ns == 10**9
