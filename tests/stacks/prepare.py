"""Writes what the emulated machine plays to its cameras: a rig, one picture of each camera, and where the joints are.

Drawing them here and not there saves minutes. Usage: prepare.py FOLDER
"""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from rhot.rig.toml_edit import change_rig_file
from rhot_sim.rendering.renderer import Renderer
from rhot_sim.rig.calibration import true_cameras
from rhot_sim.rig.folder import write_simulated_rig
from rhot_sim.world.world import World

MOMENT_S = 1.0
RATE_HZ = 5.0
DEVICES = {"left": "/dev/video20", "right": "/dev/video21"}


def main(folder: Path) -> None:
    """Write `rig`, `pictures.npz` and `truth.json`."""
    rig = write_simulated_rig(folder / "rig", rate_hz=RATE_HZ)
    world, pictures = World.from_rig(rig), dict[str, Any]()
    for number, (name, camera) in enumerate(true_cameras(rig).items()):
        drawn = Renderer(camera, world, rig.config.sim, rig.config.cameras[name], number).render(MOMENT_S)
        # As a webcam sends it: colour at half the resolution.
        pictures[name] = cv2.cvtColor(drawn, cv2.COLOR_BGR2YUV_YUY2)
    np.savez(folder / "pictures.npz", **pictures)
    change_rig_file(rig.path, {("cameras", name): {"source": "v4l2", "device": path} for name, path in DEVICES.items()})
    joints = world.truth(MOMENT_S, 0).hands["right"]
    (folder / "truth.json").write_text(json.dumps({name: pose.position for name, pose in joints.items()}))


if __name__ == "__main__":
    main(Path(sys.argv[1]))
