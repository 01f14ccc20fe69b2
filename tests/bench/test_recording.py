"""How two recordings are compared, and the traffic that is recorded."""

from __future__ import annotations

import itertools
import math
from pathlib import Path

import numpy as np
from hand_messages import point_set

from rhot.messages import Message, encode, encoding_of
from rhot.recording.mcap.writer import McapWriter
from rhot_bench.recording import Take, endless, misplaced_count, missing_count


def write(file: Path, order: list[int]) -> Take:
    with McapWriter(file, now_ns=0) as writer:
        for index, number in enumerate(order):
            points = point_set(10**18 + number)
            writer.write("rhot/points", encoding_of(type(points)), encode(points), points.t_ns, 0, 10**18 + index)
    return Take.of(file)


def test_losses_and_order_are_told_apart(tmp_path: Path) -> None:
    whole = write(tmp_path / "whole.mcap", [0, 1, 2, 3])
    assert np.diff(whole.log_ns).tolist() == [1, 1, 1]
    swapped = write(tmp_path / "swapped.mcap", [0, 2, 1, 3])
    short = write(tmp_path / "short.mcap", [0, 1, 3])
    assert (missing_count(whole.content, whole.content), misplaced_count(whole.content, whole.content)) == (0, 0)
    assert (missing_count(whole.content, swapped.content), misplaced_count(whole.content, swapped.content)) == (0, 2)
    assert missing_count(whole.content, short.content) == 1
    assert math.isnan(misplaced_count(whole.content, short.content))


def test_traffic_goes_on_evenly() -> None:
    script: list[tuple[float, str, Message]] = [(0.0, "a", point_set(1)), (4.9, "a", point_set(2))]
    times = [due_s for due_s, _, _ in itertools.islice(endless(script), 5)]
    assert times == [0.0, 4.9, 5.0, 9.9, 10.0]
