"""Reads hands live in Isaac Teleop, through OpenXR, and prints each as a line of JSON. Usage: isaac.py UPDATES."""

from __future__ import annotations

import json
import sys
import time

import numpy as np
from isaacteleop.deviceio_session import DeviceIOSession
from isaacteleop.deviceio_trackers import HandTracker
from isaacteleop.oxr import OpenXRSession

tracker = HandTracker()
extensions = DeviceIOSession.get_required_extensions([tracker])
with OpenXRSession("isaac", extensions) as xr, DeviceIOSession.run([tracker], xr.get_handles()) as session:
    for _ in range(int(sys.argv[1])):
        t_ns = time.monotonic_ns()
        session.update()
        said: dict[str, object] = {"t_ns": (t_ns + time.monotonic_ns()) // 2}
        for side in ("left", "right"):
            if (hand := getattr(tracker, f"get_{side}_hand")(session)) is not None:
                joints = hand.joints
                parts = [joints.positions, joints.orientations, joints.radii[:, None], joints.is_valid[:, None]]
                said[side] = np.concatenate([np.asarray(part, float) for part in parts], axis=1).tolist()
        sys.stdout.write(json.dumps(said) + "\n")
        time.sleep(0.02)
