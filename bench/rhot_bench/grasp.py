"""`rhot evaluate grasp`: the thesis's grabbing test as figures."""

from __future__ import annotations

import asyncio
import csv
import gzip
import json
import re
import tempfile
from collections.abc import Callable
from contextlib import ExitStack
from pathlib import Path
from typing import Any, Final

import click
import cv2
import numpy as np
from rich.console import Console

from rhot.anatomy.skeleton import FINGERS
from rhot.arrays import FloatArray
from rhot.bus import CONNECT_S, Bus
from rhot.cli.options import FiniteRange, bus_options, rig_option, tool_bus
from rhot.errors import BusError, ConfigError
from rhot.messages import BoxShape, CylinderShape, HandPose, Message, ObjectPose, SphereShape
from rhot.messages.base import wire_position
from rhot.messages.tracked import ObjectShape
from rhot.offline import MessagesBeside, core, track_with
from rhot.recording import load_recording
from rhot.recording.messages import RecordedMessages
from rhot.report.svg import line_plot
from rhot.rig import BusConfig, Rig
from rhot.rig.folder import write_text_atomic
from rhot_bench.hands.accuracy import START_NS
from rhot_bench.pictures.rendered import at_rate_of, found_markers, prepare_rig, require_pictures
from rhot_bench.speed.simulated import world_of
from rhot_bench.tracking.tracking import scene_frames, simulated_rig
from rhot_objects.assemble import plan_sources
from rhot_objects.offline import PlayedObjects
from rhot_sim.world.world import World
from rhot_tools.grasp.figures import GraspFigures, grasp_figures, grasp_sections
from rhot_tools.grasp.pickups import as_true
from rhot_tools.grasp.session import PALM, TIPS, GraspSession, grasp_session
from rhot_tools.measures.output import counted, html_report, json_option, page_option, show
from rhot_tools.measures.rows import check_output

# Where a grasping session comes from: the simulated rig, rendered pictures, a recording, the running rig.

SEQUENCE = "G2"


def simulated(
    rig: Rig, seconds: float, advance: Callable[[], None]
) -> tuple[list[tuple[str, Message]], Callable[[GraspSession], GraspSession]]:
    """Track the simulated rig's pictures; return what it publishes and what gives the truth beside a session."""
    world = world_of(rig, 1.0)
    frames = scene_frames(rig, world, seconds, advance)
    objects = PlayedObjects(plan_sources(rig), START_NS)
    messages = list(track_with(core("fusion")(rig), core("ik")(rig), frames, objects))
    return messages, lambda session: _truth(session, world)


def rendered(data: Path, keep: Path, advance: Callable[[], None] = lambda: None) -> list[tuple[str, Message]]:
    """Track the rendered grasp; its object stands where the truth says, as a tracker on it would tell."""
    rig = prepare_rig(data, keep / "rig")
    frames = found_markers(rig, data, SEQUENCE, keep, advance)
    at_rate = at_rate_of(rig, load_recording(data / SEQUENCE))
    objects = MessagesBeside(("rhot/object/held", pose) for pose in _rendered_object(data))
    return list(track_with(core("fusion")(at_rate), core("ik")(at_rate), frames, objects))


async def listened(
    bus_config: BusConfig, seconds: float, progress: Callable[[float], None]
) -> list[tuple[str, Message]]:
    """Return what the running rig publishes of hands and objects.

    Args:
        bus_config: how to reach it.
        seconds: how long to listen.
        progress: called with the seconds that have passed.

    Raises:
        BusError: no router, or nothing came.
    """
    messages: list[tuple[str, Message]] = []
    async with await Bus.open(bus_config, timeout_s=CONNECT_S) as bus:
        begun = asyncio.get_running_loop().time()

        async def follow(keys: str, model: type[Message]) -> None:
            async for sample, message in bus.events(keys).messages(model):
                progress(asyncio.get_running_loop().time() - begun)
                messages.append((sample.key, message))

        try:
            async with asyncio.timeout(seconds), asyncio.TaskGroup() as tasks:
                tasks.create_task(follow("rhot/hand/*", HandPose))
                tasks.create_task(follow("rhot/object/*", ObjectPose))
        except TimeoutError:
            pass
    if not messages:
        raise BusError(
            f"no hand and no object came in {seconds:g} s; is the rig running and started (see `rhot status`)?"
        )
    return sorted(messages, key=lambda each: each[1].t_ns)


def _truth(session: GraspSession, world: World) -> GraspSession:
    sample = world.sample(np.asarray((session.t_ns - START_NS) * 1e-9, dtype=np.float64))
    (joints,) = sample.joints.values()
    (objects,) = sample.objects.values()
    return as_true(session, joints.positions, joints.rotations[:, PALM], objects)


def _rendered_object(data: Path) -> list[ObjectPose]:
    """Return the true poses of the rendered object, rig frame.

    Raises:
        ConfigError: the files are not as their README says.
    """
    file = data / SEQUENCE / "truth_500hz.csv.gz"
    try:
        size = json.loads((data / "hand.json").read_text(encoding="utf-8"))["object"]
        shape = _rendered_shape(size)
        with gzip.open(file, "rt", encoding="utf-8", newline="") as lines:
            return [_object_pose(row, shape) for row in csv.DictReader(lines)]
    except (OSError, KeyError, ValueError) as error:
        raise ConfigError(f"{file}: cannot be used as the truth of the rendered object: {error}") from error


def _rendered_shape(size: dict[str, Any]) -> ObjectShape:
    if "bar_radius_mm" in size:
        raise ValueError(f"a {size['type']} is a mesh, which this set holds no file of")
    if "height_mm" in size:
        return CylinderShape(radius=1e-3 * size["radius_mm"], height=1e-3 * size["height_mm"])
    if "radius_mm" in size:
        return SphereShape(radius=1e-3 * size["radius_mm"])
    x, y, z = (1e-3 * float(edge) for edge in size["size_mm"])
    return BoxShape(size=(x, y, z))


def _object_pose(row: dict[str, str], shape: ObjectShape) -> ObjectPose:
    position: FloatArray = 1e-3 * np.array([float(row[f"obj_{axis}"]) for axis in "xyz"])
    x, y, z, w = (float(row[f"obj_q{axis}"]) for axis in "xyzw")
    return ObjectPose(
        t_ns=int(row["t_ns"]),
        frame="rig",
        position=wire_position(position),
        orientation=(x, y, z, w),
        state="measured",
        shape=shape,
    )


_CYCLE_S: Final = 16.0
"""Of the simulated script: a gesture, a grasp, a gesture."""
_SHAPES: Final = {"box": 3, "cylinder": 2, "sphere": 1}


class _ShapeType(click.ParamType[ObjectShape]):
    name = "KIND:MM,…"

    def convert(self, value: object, param: click.Parameter | None, ctx: click.Context | None) -> ObjectShape:
        match = re.fullmatch(r"(box|cylinder|sphere):([0-9.,]+)", str(value))
        numbers: list[float] = []
        if match:
            try:
                numbers = [1e-3 * float(part) for part in match.group(2).split(",")]
            except ValueError:
                numbers = []
        if not match or len(numbers) != _SHAPES[match.group(1)] or not all(0.0 < size <= 10.0 for size in numbers):
            self.fail(f"{value!r} is no shape; write box:X,Y,Z or cylinder:RADIUS,HEIGHT or sphere:RADIUS, in mm")
        if match.group(1) == "box":
            return BoxShape(size=(numbers[0], numbers[1], numbers[2]))
        if match.group(1) == "cylinder":
            return CylinderShape(radius=numbers[0], height=numbers[1])
        return SphereShape(radius=numbers[0])


@click.command()
@click.argument("data_path", metavar="[DATA]", required=False, type=click.Path(path_type=Path, exists=True))
@click.option("--live", "live_s", type=FiniteRange(2.0, 3600.0), metavar="SECONDS", help="Listen to the running rig.")
@click.option("--grasps", type=click.IntRange(1, 100), default=3, show_default=True, help="Simulated only: how many.")
@click.option("--seed", type=click.IntRange(0), default=1, show_default=True, help="Simulated only: of the world.")
@click.option("--hand", type=click.Choice(["left", "right"]), help="Which hand, if there are both.")
@click.option("--object", "item", metavar="ID", help="Which object, if there are several.")
@click.option("--shape", type=_ShapeType(), help="Of the object, where the recording does not say: cylinder:30,90.")
@click.option(
    "--keep",
    "keep_path",
    type=click.Path(path_type=Path, file_okay=False),
    help="Rendered pictures only: keep rig and markers in this folder, see `rhot evaluate pictures`.",
)
@json_option
@page_option("--report")
@rig_option
@bus_options
def grasp(
    data_path: Path | None,
    live_s: float | None,
    grasps: int,
    seed: int,
    hand: str | None,
    item: str | None,
    shape: ObjectShape | None,
    keep_path: Path | None,
    json_path: Path | None,
    page_path: Path | None,
    rig_path: Path,
    connect: tuple[str, ...],
    namespace: str | None,
) -> None:
    """Measure how well grasping is tracked: reach, close, carry, release.

    Without DATA the simulated rig grasps a box. DATA is an MCAP file of `rhot record`, JSON Lines of `rhot process`
    with objects in it, or the folder of the rendered pictures.

    \b
    rhot evaluate grasp
    rhot evaluate grasp session.mcap --report grasp.html
    rhot evaluate grasp --live 60 --rig RIG

    Pick-ups are detected automatically: the object moves while the thumb and a finger are near its surface. The
    object's shape must be known, from `shape = …` under [objects.NAME] of rig.toml or by --shape.
    """
    check_output("--json", json_path)
    check_output("--report", page_path)
    if data_path is not None and live_s is not None:
        raise ConfigError("give either DATA or --live SECONDS")
    cv2.setNumThreads(1)
    truth: Callable[[GraspSession], GraspSession] | None = None
    console = Console(stderr=True, soft_wrap=True)
    with ExitStack() as stack:
        progress = stack.enter_context(counted(console))
        messages: list[tuple[str, Message]]
        if live_s is not None:
            task = progress.add_task("listening", total=round(live_s))
            bus = tool_bus(rig_path, connect, namespace)
            messages = asyncio.run(listened(bus, live_s, lambda s: progress.update(task, completed=int(s))))
            source = f"the running rig, {live_s:g} s"
        elif data_path is None:
            rig = stack.enter_context(simulated_rig(None, progress, seed))
            seconds = _CYCLE_S * grasps
            rate_hz = sum(camera.rate_hz for camera in rig.config.cameras.values())
            task = progress.add_task("tracking simulated pictures", total=round(seconds * rate_hz))
            messages, truth = simulated(rig, seconds, lambda: progress.advance(task))
            source = f"the simulated rig, seed {seed}"
        elif data_path.is_dir():
            data = require_pictures(data_path)
            keep = keep_path or Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="rhot-grasp-")))
            keep.mkdir(parents=True, exist_ok=True)
            task = progress.add_task("rendered pictures", total=None)
            messages = rendered(data, keep, lambda: progress.advance(task))
            source = "the rendered grasp; its object stands where the truth says"
        else:
            messages = list(RecordedMessages(data_path))
            source = data_path.name
    session = grasp_session(messages, hand, item, shape)
    found = grasp_figures(session)
    sections = grasp_sections(session, found, None if truth is None else truth(session))
    show("evaluate grasp", sections, json_path, source=source)
    if page_path is not None:
        text = f"From {source}. Gaps are those of the flesh of a fingertip from the object's surface."
        write_text_atomic(page_path, html_report("Grasping", text, sections, _plots(session, found)))
        console.print(f"report: {page_path}", markup=False)


def _plots(session: GraspSession, found: GraspFigures) -> list[str]:
    t_s = session.t_s
    tips = {finger: (t_s, 1e3 * found.gaps[:, tip].clip(max=0.15)) for finger, tip in zip(FINGERS, TIPS, strict=True)}
    plots = [line_plot("Gap between fingertips and surface", "time [s]", "gap [mm]", tips)]
    for number, each in enumerate(found.pickups, start=1):
        rows = slice(each.reach.start, each.release.stop)
        one = {name: (t[rows], gap[rows]) for name, (t, gap) in tips.items()}
        plots.append(line_plot(f"Pick-up {number}", "time [s]", "gap [mm]", one))
    return plots
