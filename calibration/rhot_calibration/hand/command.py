"""`rhot calibrate hand`."""

from __future__ import annotations

import asyncio
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import Any

import click
from rich.console import Console
from rich.progress import Progress, SpinnerColumn, TextColumn, TimeElapsedColumn

from rhot.cli.options import Finite, bus_options, rig_option, tool_bus
from rhot.errors import ConfigError
from rhot.messages import PointSet, Side
from rhot.recording import load_recording
from rhot.report.html import figures_table
from rhot.rig import BusConfig, HandFile, Rig, load_rig
from rhot.rig.calibration import today
from rhot.rig.folder import HAND_FILE
from rhot_calibration.hand.calibration import measure_hand, typed_hand
from rhot_calibration.hand.samples import (
    LIVE_PHASES,
    LIVE_S,
    Phases,
    PoseWindow,
    live_points,
    prompt_at,
    recorded_points,
    stored_points,
)
from rhot_calibration.options import live_option
from rhot_calibration.writing import write_found


class _Stretch(click.ParamType[PoseWindow]):
    name = "seconds"

    def convert(self, value: object, param: click.Parameter | None, ctx: click.Context | None) -> PoseWindow:
        if isinstance(value, PoseWindow):
            return value
        start, dash, end = str(value).partition("-")
        try:
            window = PoseWindow(float(start), float(end))
        except ValueError:
            self.fail(f"{value!r} is not START-END in seconds, such as 1.5-4", param, ctx)
        if not dash or not 0.0 <= window.start_s < window.end_s < float("inf"):
            self.fail(f"{value!r}: START must be 0 or more and END later, in seconds", param, ctx)
        return window


@click.command()
@click.argument("recording_path", metavar="[RECORDING]", required=False, type=click.Path(path_type=Path))
@live_option(f"Use the running rig; tells you what to do, {LIVE_S:.0f} s in all.")
@click.option(
    "--flat", metavar="START-END", type=_Stretch(), help="When the hand is flat, s from the start.  [default: found]"
)
@click.option(
    "--knuckles",
    metavar="START-END",
    type=_Stretch(),
    help="When straight fingers bend at the knuckles only.  [default: found]",
)
@click.option("--length-mm", type=Finite(), help="By a ruler: wrist crease to middle tip; alone or beside a recording.")
@click.option(
    "--width-mm", type=Finite(), help="By a ruler: across the knuckles of the four fingers; without a recording."
)
@click.option("--side", type=click.Choice(["left", "right"]), help="Which hand, where rig.toml has two.")
@rig_option
@bus_options
def hand(
    recording_path: Path | None,
    live: bool,
    flat: PoseWindow | None,
    knuckles: PoseWindow | None,
    length_mm: float | None,
    width_mm: float | None,
    side: Side | None,
    rig_path: Path,
    connect: tuple[str, ...],
    namespace: str | None,
) -> None:
    """Measure a hand (bone lengths, positions of its markers) and write hand.json into the rig folder.

    The previous file is kept as hand.previous.json.

    \b
    rhot calibrate hand take.mcap --rig myrig         a recording, or a .jsonl file of `rhot process`
    rhot calibrate hand --live --rig myrig            the running rig; says what to do and when
    rhot calibrate hand --length-mm 189 --width-mm 84 --rig myrig       two measures of a ruler

    The hand needs a rectangular patch on its back and a painted tip on each finger. Show the cameras its back:

    \b
    1. FLAT, 3 s       hand flat and still, fingers straight and a little spread
    2. KNUCKLES, 10 s  fingers kept straight, bent at the knuckles only: down to 60° or more and up, three times
    3. FREE, 6 s       bend everything as you like; this only checks the result

    Flat fingers give the reach of the tips. Straight fingers that bend at the knuckles move on circles, which give the
    knuckle positions and finger lengths. The individual bones, the thumb and everything else that a recording does not
    show follow from the proportions of an average hand; the table states the source and accuracy of each length:
    measured is within 2 mm, roughly measured within 4 mm. An additional ruler measurement (--length-mm) improves the
    rest.
    """
    ways = (recording_path is not None) + live
    if ways == 2 or (ways == 0 and length_mm is None and width_mm is None):
        raise ConfigError(
            "give one of: a RECORDING (.mcap, folder, or .jsonl of `rhot process`), --live, or --length-mm with "
            "--width-mm"
        )
    if width_mm is not None and ways:
        raise ConfigError("--width-mm serves only without a recording; leave it out, or leave the recording out")
    if (flat or knuckles) and recording_path is None:
        raise ConfigError("--flat and --knuckles are seconds of a RECORDING; give one, or leave them out")
    if width_mm is not None and length_mm is None:
        raise ConfigError(f"--width-mm {width_mm:g} alone says too little; give --length-mm too")
    rig = load_rig(rig_path)
    console = Console(stderr=True, soft_wrap=True)
    if ways == 0 and length_mm is not None:
        found = typed_hand(length_mm / 1e3, None if width_mm is None else width_mm / 1e3)
    else:
        chosen = _side(rig, side)
        typed_m = None if length_mm is None else typed_hand(length_mm / 1e3, None).length_m
        phases = LIVE_PHASES if live else Phases(flat, knuckles)
        columns = (SpinnerColumn(), TextColumn("{task.description}"), TimeElapsedColumn())
        with Progress(*columns, console=console) as progress:
            task = progress.add_task("starting")

            def report(text: str) -> None:
                progress.update(task, description=text)

            points: Iterable[PointSet]
            if live:
                points = _listen(tool_bus(rig_path, connect, namespace), report)
            else:
                points = _points(rig, recording_path or Path(), report)
            found = measure_hand(points, rig, chosen, phases, typed_m, report)
    file = rig_path / HAND_FILE
    _report(found)
    write_found(
        Console(soft_wrap=True),
        file,
        found.model_copy(update={"date": today()}),
        "`rhot ik` takes it at the next `rhot start`.",
    )


def _side(rig: Rig, side: Side | None) -> Side:
    worn = rig.config.sides
    if side is not None and side not in worn:
        raise ConfigError(f"--side {side}: rig.toml has markers of the {' and '.join(worn)} hand only")
    if side is None and len(worn) > 1:
        raise ConfigError(
            "rig.toml has markers of two hands; say which one is measured with --side (one hand.json serves both)"
        )
    return side or worn[0]


def _points(rig: Rig, path: Path, report: Callable[[str], None]) -> Iterator[PointSet]:
    if path.is_file():
        yield from stored_points(path)
        return
    recording = load_recording(path)
    frames = 0

    def on_frame() -> None:
        nonlocal frames
        frames += 1
        report(f"tracking the recording: {frames} frames")

    yield from recorded_points(rig, recording, on_frame)


def _listen(bus: BusConfig, report: Callable[[str], None]) -> list[PointSet]:
    def on_time(passed_s: float, count: int) -> None:
        left_s, doing = prompt_at(passed_s)
        report(f"{left_s:3.0f} s  {doing}  ({count} point sets)")

    return asyncio.run(live_points(bus, LIVE_S, on_time))


def _report(found: HandFile) -> None:
    console = Console(soft_wrap=True)
    quality = found.quality
    if quality["source"] == "typed in":
        width = quality["width"]
        console.print(f"hand {quality['length']['mm']:g} mm long, {width['mm']:g} mm wide ({width['source']})")
        console.print("all bones from proportions; a recording measures them: rhot calibrate hand --help")
    else:
        table = figures_table("length", "mm", "± mm")
        table.add_column("source")
        rows = {"hand: wrist crease to middle tip": quality["length"], "hand: across the knuckles": quality["width"]}
        rows |= {f"{finger}: patch to tip marker, straight": figure for finger, figure in quality["reach"].items()}
        rows |= {f"{finger}: knuckle to tip joint": figure for finger, figure in quality["fingers"].items()}
        rows |= {f"bone before {joint}": figure for joint, figure in quality["bones"].items()}
        for name, figure in rows.items():
            table.add_row(name, f"{figure['mm']:.1f}", f"{2 * figure['sd_mm']:.1f}", figure["source"])
        console.print(table)
        console.print("± is two standard deviations: about 95 of 100 true lengths lie inside")
        _report_motion(console, quality)


def _report_motion(console: Console, quality: dict[str, Any]) -> None:
    start, end = quality["flat_s"]
    text = f"flat at {start:g} to {end:g} s"
    if quality["knuckles_s"]:
        start, end = quality["knuckles_s"]
        arcs = ", ".join(f"{finger} {arc:.0f}°" for finger, arc in quality["arc_deg"].items() if finger != "thumb")
        text += f"; straight fingers bent at the knuckles within {start:g} to {end:g} s: {arcs}"
    console.print(f"{text}; {quality['frames']} of {quality['samples']} samples used")
    if not quality["palm_from_corners"]:
        console.print(
            "the corners of the patch were not seen, so the palm's turn is unknown: lengths follow from reaches alone",
            style="yellow",
        )
    elif not quality["knuckles_s"]:
        console.print(
            "no straight fingers bending at the knuckles were found: knuckles follow from proportions (--knuckles "
            "START-END says when, --live leads through it)",
            style="yellow",
        )
