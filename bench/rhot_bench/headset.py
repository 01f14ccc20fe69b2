"""`rhot evaluate headset`: how well the feet's camera is found on the headset, on drawn pictures with a truth."""

from __future__ import annotations

import tempfile
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import click
import cv2
import numpy as np
from rich import box
from rich.console import Console
from rich.table import Table

from rhot.recording.camera_picture import jpeg_of
from rhot_bench.feet.heads import START_NS, Heads
from rhot_calibration.headset.checks import FOOT_M, judged
from rhot_calibration.headset.collector import ViewCollector
from rhot_calibration.headset.fit import HeadsetFit, mounting_error
from rhot_feet.frames import pinhole
from rhot_sim.walker.folder import write_walker_rig
from rhot_sim.walker.world import WalkerWorld

_RATE_HZ: Final = 10.0
_FROM_S: Final = 0.7
_HEAD_AHEAD_S: Final = 0.05


@dataclass(frozen=True, slots=True)
class _Found:
    seed: int
    views: int
    fit: HeadsetFit
    rotation_deg: float
    position_mm: float
    foot_mm: float


@click.command()
@click.option("--seeds", type=click.IntRange(1, 100), default=8, show_default=True, help="Simulated persons.")
@click.option("--seconds", type=click.FloatRange(10, 30), default=29.0, show_default=True, help="How long each looks.")
def headset(seeds: int, seconds: float) -> None:
    """Let simulated persons look at a marker on the floor, calibrate, and compare with where the camera truly sits.

    Each has a camera that sits askew by up to 4 degrees and 2 cm about and along each axis. Pictures are drawn, and
    coded as recordings are; the head's poses have the noise of a Vive tracker: 0.3 mm and 0.1 degrees per axis.
    """
    with Console(stderr=True).status("looking"), tempfile.TemporaryDirectory(prefix="rhot-headset-") as folder:
        found = [_calibrated(Path(folder) / f"{seed}", seed, seconds) for seed in range(1, seeds + 1)]
    Console().print(_table(found))


def _calibrated(folder: Path, seed: int, seconds: float) -> _Found:
    rig = write_walker_rig(folder, endpoint="tcp/127.0.0.1:7", seed=seed, motion="headset", rate_hz=_RATE_HZ)
    world = WalkerWorld.from_rig(rig)
    feet = world.feet_config
    camera = pinhole(feet.camera.width, feet.camera.height, world.intrinsics, np.empty(0))
    collector, heads = ViewCollector(feet), Heads(world, seed)
    for index in range(round(_FROM_S * _RATE_HZ), round(seconds * _RATE_HZ)):
        if world.timing(index).dropped:
            continue
        t_s, color, _ = world.frame(index)
        coded = cv2.imdecode(np.frombuffer(jpeg_of(color), np.uint8), cv2.IMREAD_COLOR)
        found = collector.find(np.asarray(coded, np.uint8))
        collector.add_picture(START_NS + round(1e9 * t_s), found, camera)
        for pose in heads.until(t_s + _HEAD_AHEAD_S):
            collector.add_head(pose)
    fit = judged(rig, collector, feet.marker_size_m).fit
    angle_rad, distance_m = mounting_error(fit.T_head_camera, world.T_head_camera)
    foot = (fit.T_head_camera - world.T_head_camera) @ [0.0, 0.0, FOOT_M, 1.0]
    return _Found(
        seed,
        len(collector.views),
        fit,
        float(np.degrees(angle_rad)),
        1e3 * distance_m,
        1e3 * float(np.linalg.norm(foot)),
    )


def _table(found: Sequence[_Found]) -> Table:
    table = Table(title="Camera on the headset: off by", title_justify="left", box=box.SIMPLE_HEAD, show_edge=False)
    columns = (
        "seed",
        "views",
        "rotation °",
        "position mm",
        f"foot at {FOOT_M:g} m, mm",
        "stated foot sd, mm",
        "residual px",
    )
    for column in columns:
        table.add_column(column, justify="right")
    for each in found:
        stated_mm = 1e3 * each.fit.foot_sd_m(FOOT_M)
        figures = (each.rotation_deg, each.position_mm, each.foot_mm, stated_mm, each.fit.rms_px)
        table.add_row(f"{each.seed}", f"{each.views}", *(f"{value:.2f}" for value in figures))
    rows = np.array([(each.rotation_deg, each.position_mm, each.foot_mm) for each in found])
    for name, values in (("median", np.median(rows, axis=0)), ("worst", rows.max(axis=0))):
        table.add_row(name, "", *(f"{value:.2f}" for value in values), "", "")
    return table
