"""`rhot evaluate two-hands`: both hands that touch and cross, against the truth."""

from __future__ import annotations

import contextlib
import tempfile
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import click
import cv2
import numpy as np
from rich.console import Console

from rhot.anatomy.hand import HandModel
from rhot.arrays import FloatArray
from rhot.cli.options import FiniteRange
from rhot.messages import HandPose, MarkerFrame, PointSet, Side
from rhot.offline import core, track_smoothly, track_with
from rhot.rig import Rig
from rhot_bench.measures.hands import START_NS, against_truth, hand_figures
from rhot_bench.speed.simulated import world_of
from rhot_bench.tracking.projected import named_frames
from rhot_bench.tracking.simulated_rig import RATE_HZ
from rhot_bench.tracking.tracking import MM, SETTLE_S, scene_frames
from rhot_sim.rig.folder import true_cameras, with_motion, write_simulated_rig
from rhot_sim.world.world import World
from rhot_tools.measures.output import counted, json_option, show
from rhot_tools.measures.points import PointTrack, false_points, identity_swaps, point_track
from rhot_tools.measures.rows import Row, Section, check_output

SIDES: Final[tuple[Side, Side]] = ("right", "left")
_WRONG_PX: Final = 14.0
"""A blob further than this from its marker's true centre, a fingertip's width in the picture, is not that marker."""


@click.command("two-hands")
@click.option(
    "--duration",
    "duration_s",
    type=FiniteRange(1, 3600),
    default=20.0,
    show_default=True,
    help="Seconds of pictures. Each takes about three of computing: one to draw it and find markers, two to track it. "
    "24 seconds show two cycles.",
)
@click.option(
    "--names-for",
    "names_s",
    type=FiniteRange(0, 36000),
    default=300.0,
    show_default=True,
    help="Seconds of blobs without pictures, for which hand they are said to be; 0 leaves this out.",
)
@click.option(
    "--paints",
    type=click.Choice(["shared", "own"]),
    default="shared",
    show_default=True,
    help="shared: the left fingertips wear the right ones' paints. own: twelve paints, which only a simulated camera "
    "tells apart.",
)
@click.option(
    "--seed", type=click.IntRange(0, 2**63 - 1), default=1, show_default=True, help="Seed of the simulated world."
)
@json_option
def two_hands(duration_s: float, names_s: float, paints: str, seed: int, json_path: Path | None) -> None:
    """Track two simulated hands that touch and cross, and compare with the truth.

    Every twelve seconds the hands turn their fingertips towards each other, touch, part, cross one above the other and
    go back: at 60 fps, with all faults of the simulated rig. Offline is what `rhot process --smooth` makes of it.

    Which hand: the same motion for minutes, as blobs without pictures, through the detector's naming of shared paints
    and through fusion. A swap is a marker that is measured at one of the other hand.
    """
    check_output("--json", json_path)
    cv2.setNumThreads(1)
    console = Console(stderr=True, soft_wrap=True)
    sections: list[Section] = []
    with _crossing_rig(seed, share=paints == "shared") as rig, counted(console) as progress:
        world = world_of(rig)
        rate_hz = sum(camera.rate_hz for camera in rig.config.cameras.values())
        task = progress.add_task("rendering and finding", total=round((SETTLE_S + duration_s) * rate_hz))
        frames = list(scene_frames(rig, world, SETTLE_S + duration_s, lambda: progress.advance(task)))
        for title, smooth in (("Offline, 60 fps", True), ("As they come, 60 fps", False)):
            waiting = progress.add_task(title, total=None)
            sections.append(_section(f"Two hands: {title}", rig, world, frames, smooth=smooth))
            progress.remove_task(waiting)
        sections.append(_naming_section(f"Which hand: {duration_s:g} s of pictures", wrong_names(rig, world, frames)))
        if names_s > 0.0:
            waiting = progress.add_task("blobs without pictures", total=None)
            sections.append(_long_section(rig, world, names_s, seed))
            progress.remove_task(waiting)
    show("evaluate two-hands", sections, json_path, seed=seed, seconds=duration_s, names_s=names_s, paints=paints)


@contextlib.contextmanager
def _crossing_rig(seed: int, *, share: bool) -> Iterator[Rig]:
    with tempfile.TemporaryDirectory(prefix="rhot-bench-") as folder:
        rig = write_simulated_rig(Path(folder) / "rig", rate_hz=RATE_HZ, seed=seed, sides=SIDES, share_paints=share)
        yield with_motion(rig, "crossing")


@dataclass(frozen=True, slots=True)
class Naming:
    """What blobs were called.

    Attributes:
        named: blobs of fingertips that got a name.
        wrong: of these, so many lie elsewhere than the marker of that name.
    """

    named: int
    wrong: int


def wrong_names(rig: Rig, world: World, frames: list[MarkerFrame]) -> Naming:
    """Compare what fingertips are called in pictures with the truth."""
    t_s = np.array([(frame.t_ns - START_NS) * 1e-9 for frame in frames])
    true = world.sample(t_s).markers
    tips = [name for name, marker in world.markers.items() if marker.kind == "cap"]
    named = wrong = 0
    for name, camera in true_cameras(rig).items():
        for tip in tips:
            rows = [row for row, frame in enumerate(frames) if frame.camera == name and tip in frame.markers]
            seen = np.array([(frames[row].markers[tip].u, frames[row].markers[tip].v) for row in rows]).reshape(-1, 2)
            off = camera.project(true[tip][rows]) - seen
            named += len(rows)
            wrong += int(np.count_nonzero(np.hypot(off[:, 0], off[:, 1]) > _WRONG_PX))
    return Naming(named, wrong)


def _section(title: str, rig: Rig, world: World, frames: list[MarkerFrame], *, smooth: bool) -> Section:
    sets: list[PointSet] = []
    poses: list[HandPose] = []
    messages = track_smoothly(rig, iter(frames)) if smooth else track_with(core("fusion")(rig), core("ik")(rig), frames)
    for _, message in messages:
        if isinstance(message, PointSet):
            sets.append(message)
        elif isinstance(message, HandPose):
            poses.append(message)
    points = point_track(sets, world, START_NS).after(SETTLE_S)
    errors = _tip_errors_mm(points, world)
    limits = (1.5, 5.0) if smooth else (None, None)
    rows = [
        Row("fingertip position, median", _percentile(errors, 50), "mm", most=limits[0]),
        Row("fingertip position, p95", _percentile(errors, 95), "mm", most=limits[1]),
        Row("fingertip position, p99", _percentile(errors, 99), "mm"),
        Row(
            "fingertips measured", 100.0 * float(np.isfinite(errors).mean()), "%", note="of all moments, hidden or not"
        ),
        *_trust_rows(points, world),
    ]
    for side in SIDES:
        mine = [pose for pose in poses if pose.side == side]
        if mine:
            model = HandModel.from_file(rig.hand, side)
            figures = hand_figures(against_truth(mine, world, side, START_NS), model, SETTLE_S)
            rows.append(Row(f"{side} hand, 26 joints, all tips measured, mean", figures.joints_mm, "mm"))
            rows.append(Row(f"{side} hand, 26 joints, p95", figures.joints_p95_mm, "mm"))
    return Section(title, tuple(rows))


def _long_section(rig: Rig, world: World, seconds: float, seed: int) -> Section:
    frames = list(named_frames(rig, world, SETTLE_S + seconds, seed))
    fusion = core("fusion")(rig)
    sets = [points for frame in frames for _, points in fusion.feed(frame)]
    points = point_track(sets, world, START_NS).after(SETTLE_S)
    naming = _naming_section("", wrong_names(rig, world, frames)).rows
    return Section(f"Which hand: {seconds:g} s of blobs without pictures", (*naming, *_trust_rows(points, world)))


def _naming_section(title: str, naming: Naming) -> Section:
    share = 100.0 * naming.wrong / max(naming.named, 1)
    note = f"{naming.wrong} of {naming.named}; {_WRONG_PX:g} px or more from their marker"
    return Section(title, (Row("fingertip blobs of a wrong name", share, "%", note=note),))


def _trust_rows(points: PointTrack, world: World) -> tuple[Row, ...]:
    hands = [world.markers[name].hand for name in points.names]
    seconds = f"in {points.t_s[-1] - points.t_s[0]:.0f} s" if len(points.t_s) else ""
    return (
        Row("swaps between the hands", identity_swaps(points, hands), most=0, note=seconds),
        Row("false points", false_points(points), note=f"{seconds}; no true marker within 20 mm"),
    )


def _tip_errors_mm(points: PointTrack, world: World) -> FloatArray:
    tips = [column for column, name in enumerate(points.names) if world.markers[name].kind == "cap"]
    errors: FloatArray = points.errors_m[:, tips] * MM
    return errors


def _percentile(errors: FloatArray, share: float) -> float:
    finite = errors[np.isfinite(errors)]
    return float(np.percentile(finite, share)) if finite.size else float("nan")
