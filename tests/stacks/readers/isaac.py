"""Plays an MCAP file in Isaac Teleop and prints every hand as JSON. Usage: isaac.py FILE UPDATES."""

from __future__ import annotations

import json
import sys
from typing import Any

import numpy as np
from isaacteleop.deviceio_session import McapReplayConfig, ReplaySession
from isaacteleop.deviceio_trackers import HandTracker

tracker = HandTracker()
found: dict[str, list[Any]] = {"left": [], "right": []}
with ReplaySession.run(McapReplayConfig(sys.argv[1], [(tracker, "hands")])) as session:
    for _ in range(int(sys.argv[2])):
        session.update()
        for side, hands in found.items():
            joints = getattr(tracker, f"get_{side}_hand")(session).joints
            parts = [joints.positions, joints.orientations, joints.radii[:, None], joints.is_valid[:, None]]
            hands.append(np.concatenate([np.asarray(part, float) for part in parts], axis=1).tolist())
sys.stdout.write(json.dumps(found))
