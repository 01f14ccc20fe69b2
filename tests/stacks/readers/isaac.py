"""Prints the hands that Isaac Teleop has, from an MCAP file or live through OpenXR. Usage: isaac.py UPDATES [FILE].

JSON, a row for each update: `t_ns`, monotonic; `left` and `right`, null without a hand, else for every joint position,
orientation, radius and whether it is valid.
"""

from __future__ import annotations

import contextlib
import json
import sys
import time
from collections.abc import Iterator
from typing import Any

import numpy as np
from isaacteleop.deviceio_session import DeviceIOSession, McapReplayConfig, ReplaySession
from isaacteleop.deviceio_trackers import HandTracker
from isaacteleop.oxr import OpenXRSession

LIVE_PERIOD_S = 0.02


@contextlib.contextmanager
def source(tracker: HandTracker, file: str | None) -> Iterator[Any]:
    if file is not None:
        with ReplaySession.run(McapReplayConfig(file, [(tracker, "hands")])) as replay:
            yield replay
        return
    extensions = DeviceIOSession.get_required_extensions([tracker])
    with OpenXRSession("isaac", extensions) as xr, DeviceIOSession.run([tracker], xr.get_handles()) as live:
        yield live


def rows(hand: Any) -> list[list[float]] | None:
    if hand is None:
        return None
    joints = hand.joints
    parts = [joints.positions, joints.orientations, joints.radii[:, None], joints.is_valid[:, None]]
    found: list[list[float]] = np.concatenate([np.asarray(part, float) for part in parts], axis=1).tolist()
    return found


def main(updates: str, file: str | None = None) -> None:
    tracker = HandTracker()
    found: dict[str, list[Any]] = {"t_ns": [], "left": [], "right": []}
    with source(tracker, file) as session:
        for _ in range(int(updates)):
            begun_ns = time.monotonic_ns()
            session.update()
            found["t_ns"].append((begun_ns + time.monotonic_ns()) // 2)
            found["left"].append(rows(tracker.get_left_hand(session)))
            found["right"].append(rows(tracker.get_right_hand(session)))
            if file is None:
                time.sleep(LIVE_PERIOD_S)
    sys.stdout.write(json.dumps(found) + "\n")


main(*sys.argv[1:])
