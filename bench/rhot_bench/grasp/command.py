"""`rhot evaluate grasp`: the thesis's grabbing test as figures."""

from __future__ import annotations

import asyncio
import re
import tempfile
from collections.abc import Callable
from contextlib import ExitStack
from pathlib import Path
from typing import Final

import click
import cv2
from rich.console import Console

from rhot.anatomy.skeleton import FINGERS
from rhot.cli.options import FiniteRange, bus_options, rig_option, tool_bus
from rhot.errors import ConfigError
from rhot.export.source import RecordedMessages
from rhot.messages import BoxShape, CylinderShape, Message, SphereShape
from rhot.messages.objects import ObjectShape
from rhot.report.svg import line_plot
from rhot.rig.folder import write_text_atomic
from rhot_bench.grasp.sources import listened, rendered, simulated
from rhot_bench.pictures.rendered import require_pictures
from rhot_bench.tracking.simulated_rig import simulated_rig
from rhot_tools.grasp.figures import GraspFigures, grasp_figures, grasp_sections
from rhot_tools.grasp.session import TIPS, GraspSession, grasp_session
from rhot_tools.measures.html import html_report
from rhot_tools.measures.output import counted, json_option, page_option, show
from rhot_tools.measures.rows import check_output

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
