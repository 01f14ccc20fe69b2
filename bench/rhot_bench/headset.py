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
from rich.console import Console

from rhot.cli.options import FiniteRange
from rhot.recording.camera_picture import jpeg_of
from rhot_bench.feet.heads import START_NS, Heads
from rhot_calibration.headset.fit import FOOT_M, HeadsetFit, judged, mounting_error
from rhot_calibration.headset.streams import ViewCollector
from rhot_feet.frames import pinhole
from rhot_sim.walker.folder import write_walker_rig
from rhot_sim.walker.world import WalkerWorld
from rhot_tools.measures.output import counted, json_option, show
from rhot_tools.measures.rows import Row, Section, check_output

MM: Final = 1e3
MOST_ROTATION_DEG: Final = 0.1
MOST_FOOT_MM: Final = 3.0
"""A camera must add less than the head's pose jitters by, and a thesis's marker stood within (docs/feet.md)."""
_RATE_HZ: Final = 10.0


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
@click.option("--seconds", type=FiniteRange(10, 30), default=29.0, show_default=True, help="How long each looks.")
@json_option
def headset(seeds: int, seconds: float, json_path: Path | None) -> None:
    """Calibrate from simulated persons who look at a marker on the floor, and compare with the true camera pose.

    Each camera is mounted with an error of up to 4 degrees and 2 cm about and along each axis. Images are rendered and
    encoded as in recordings; head poses have the noise of a Vive tracker: 0.3 mm and 0.1 degrees per axis.
    """
    check_output("--json", json_path)
    console = Console(stderr=True, soft_wrap=True)
    with counted(console) as progress, tempfile.TemporaryDirectory(prefix="rhot-headset-") as folder:
        persons = progress.track(range(1, seeds + 1), description="persons")
        found = [_calibrated(Path(folder) / f"{seed}", seed, seconds) for seed in persons]
    show("evaluate headset", _sections(found), json_path, seeds=seeds, seconds=seconds)


def _calibrated(folder: Path, seed: int, seconds: float) -> _Found:
    rig = write_walker_rig(folder, endpoint="tcp/127.0.0.1:7", seed=seed, motion="headset", rate_hz=_RATE_HZ)
    world = WalkerWorld.from_rig(rig)
    feet = world.feet_config
    camera = pinhole(feet.camera.width, feet.camera.height, world.intrinsics, np.empty(0))
    collector, heads = ViewCollector(feet), Heads(world, seed)
    from_s = 0.7
    for index in range(round(from_s * _RATE_HZ), round(seconds * _RATE_HZ)):
        if world.timing(index).dropped:
            continue
        t_s, color, _ = world.frame(index)
        coded = cv2.imdecode(np.frombuffer(jpeg_of(color), np.uint8), cv2.IMREAD_COLOR)
        found = collector.find(np.asarray(coded, np.uint8))
        collector.add_picture(START_NS + round(1e9 * t_s), found, camera)
        head_ahead_s = 0.05
        for pose in heads.until(t_s + head_ahead_s):
            collector.add_head(pose)
    fit = judged(rig, collector, feet.marker_size_m).fit
    angle_rad, distance_m = mounting_error(fit.T_head_camera, world.T_head_camera)
    foot = (fit.T_head_camera - world.T_head_camera) @ [0.0, 0.0, FOOT_M, 1.0]
    return _Found(
        seed,
        len(collector.views),
        fit,
        float(np.degrees(angle_rad)),
        MM * distance_m,
        MM * float(np.linalg.norm(foot)),
    )


def _sections(found: Sequence[_Found]) -> list[Section]:
    """Return the errors over all persons, and a table of each person."""
    each = {
        "rotation": ([one.rotation_deg for one in found], "°", MOST_ROTATION_DEG),
        "position": ([one.position_mm for one in found], "mm", MOST_FOOT_MM),
        f"a foot {FOOT_M:g} m away": ([one.foot_mm for one in found], "mm", MOST_FOOT_MM),
    }
    rows = []
    for name, (values, unit, most) in each.items():
        rows.append(Row(f"{name}, median", float(np.median(values)), unit))
        rows.append(Row(f"{name}, worst", max(values), unit, most=most))
    stated = [MM * one.fit.foot_sd_m(FOOT_M) for one in found]
    rows.append(Row(f"a foot {FOOT_M:g} m away, as stated", float(np.median(stated)), "mm", note="one sd, median"))
    persons = [
        Row(
            f"seed {one.seed}: a foot {FOOT_M:g} m away",
            one.foot_mm,
            "mm",
            note=f"{one.views} views, {one.fit.rms_px:.2f} px residual, {one.rotation_deg:.2f}°, "
            f"{one.position_mm:.1f} mm",
        )
        for one in found
    ]
    return [Section("Camera on the headset: off by", tuple(rows)), Section("Each person", tuple(persons))]
