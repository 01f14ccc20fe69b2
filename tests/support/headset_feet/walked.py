"""A simulated walk as `rhot record --frames` writes it: pictures, ankle sensors and the head."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np

from rhot.messages import Side
from rhot.recording.feet_tables import FeetTables, SensorSamples
from rhot.recording.picture_folder import PictureFolder
from rhot.rig import Rig
from rhot_bench.feet.heads import START_NS, Heads
from rhot_feet.frames import DepthFrame, pinhole
from rhot_feet.imu.samples import ImuSamples
from rhot_feet.input_stream import picture_of, samples_of
from rhot_sim.sources.imu import SimulatedSource
from rhot_sim.walker.world import WalkerWorld

STEP_S = 0.05
LATE_NS = 30_000_000
"""From a moment to its arrival at the recorder."""


def frames_of(world: WalkerWorld, seconds: float) -> list[DepthFrame]:
    """Draw every picture that the camera delivers; costs 20 ms each."""
    config = world.feet_config.camera
    camera = pinhole(config.width, config.height, world.intrinsics, np.empty(0))
    frames = []
    for index in range(round(seconds * config.rate_hz)):
        if not world.timing(index).dropped:
            t_s, color, depth_mm = world.frame(index)
            frames.append(DepthFrame(START_NS + round(1e9 * t_s), color, depth_mm, camera, index))
    return frames


def record_walk(rig: Rig, folder: Path, seconds: float, *, depth: bool = True) -> None:
    """Write a recording of the walk that a rig describes, with or without depth pictures."""
    world = WalkerWorld.from_rig(rig)
    heads = Heads(world, rig.config.sim.seed)
    sides: tuple[Side, Side] = ("left", "right")
    sensors = {side: SimulatedSource(world, side) for side in sides}
    for sensor in sensors.values():
        sensor.open(START_NS)
    with PictureFolder(folder) as pictures, FeetTables(lambda: pictures.depth_camera) as tables:
        for step in range(round(seconds / STEP_S) + 2):
            now_s = step * STEP_S
            for pose in heads.until(now_s):
                tables.add_head(pose, pose.t_ns + LATE_NS)
            for side, sensor in sensors.items():
                read: ImuSamples = sensor.read(START_NS + round(1e9 * now_s))
                for samples in samples_of(side, read):
                    assert isinstance(samples, SensorSamples)
                    tables.add_samples(samples, samples.t_ns + LATE_NS)
            if step == 0:
                for frame in frames_of(world, seconds):
                    shown = frame if depth else replace(frame, depth_mm=None)
                    pictures.write(picture_of(shown), frame.t_ns + LATE_NS)
