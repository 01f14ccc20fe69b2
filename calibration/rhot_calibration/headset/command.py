"""`rhot calibrate headset`."""

from __future__ import annotations

import asyncio
from pathlib import Path
from typing import Final

import click
from rich.console import Console

from rhot.cli.options import FiniteRange, bus_options, rig_option, tool_bus
from rhot.errors import BusError, ConfigError
from rhot.rig import BusConfig, load_rig
from rhot.rig.folder import HEADSET_FILE
from rhot_calibration.headset.fit import headset_file, judged, report_lines
from rhot_calibration.headset.streams import WANTED, ViewCollector, collect_views, views_recorded
from rhot_calibration.options import dry_run_option, live_option
from rhot_calibration.writing import write_found

_PATIENCE_S: Final = 30.0
_SAY_EVERY: Final = 25


@click.command()
@click.argument("recording", metavar="[RECORDING]", required=False, type=click.Path(path_type=Path, file_okay=False))
@live_option("Use the running rig.")
@click.option("--marker", "marker_id", type=click.IntRange(0), help="Number of the marker.  [default: the left foot's]")
@click.option(
    "--size-mm", type=FiniteRange(5, 500), help="Side of its black square.  [default: marker_size_m of [feet]]"
)
@click.option(
    "--views", "wanted", type=click.IntRange(40, 1000), default=WANTED, show_default=True, help="Views to take, live."
)
@dry_run_option
@rig_option
@bus_options
def headset(
    recording: Path | None,
    live: bool,
    marker_id: int | None,
    size_mm: float | None,
    wanted: int,
    dry_run: bool,
    rig_path: Path,
    connect: tuple[str, ...],
    namespace: str | None,
) -> None:
    """Find the pose of the feet's camera on the headset: its position, pitch, yaw and roll.

    Lay one of the feet's markers flat on the floor half a metre before you (nobody may wear it meanwhile), put the
    headset on and look at it from all sides for half a minute: nod, turn and tilt your head, lean to all sides, bend
    your knees. A larger marker of the same kind is even better: specify it with --marker and --size-mm.

    \b
    rhot calibrate headset --live --rig RIG
    rhot calibrate headset walk --rig RIG         a folder of `rhot record --frames`

    Writes headset.json, which overrides pitch_deg and position_m of [feet.camera]; the previous file is kept as
    headset.previous.json. `rhot feet` loads it at the next start (`rhot start`).
    """
    rig = load_rig(rig_path)
    feet = rig.config.feet
    if feet is None:
        raise ConfigError(f"{rig_path / 'rig.toml'} names no feet; add [feet.left] or [feet.right] with marker_id")
    if live == (recording is not None):
        raise ConfigError("give a folder of `rhot record --frames`, or --live")
    collector = ViewCollector(feet, marker_id, wanted)
    size_m = feet.marker_size_m if size_mm is None else 1e-3 * size_mm
    if recording is None:
        _look(tool_bus(rig_path, connect, namespace), collector)
    else:
        with Console(stderr=True).status("looking at the pictures"):
            views_recorded(recording, collector)
    found = judged(rig, collector, size_m)
    console = Console(soft_wrap=True, markup=False, highlight=False)
    for line in report_lines(found):
        console.print(line)
    for note in found.notes:
        console.print(f"note: {note}", style="yellow")
    file = rig_path / HEADSET_FILE
    then = "`rhot feet` takes it at the next start (`rhot start`)."
    write_found(console, file, headset_file(found), then, dry_run=dry_run)


def _look(bus: BusConfig, collector: ViewCollector) -> None:
    console = Console(stderr=True, soft_wrap=True, markup=False, highlight=False)
    console.print(
        f"Look at marker {collector.marker_id} on the floor from all sides, slowly, until {collector.wanted} views are "
        "taken; Ctrl-C ends with those there are."
    )

    said = 0

    def taken() -> None:
        nonlocal said
        count = len(collector.views)
        if count // _SAY_EVERY > said:
            said = count // _SAY_EVERY
            console.print(f"{count} views, {100 * collector.share:.0f} % done", style="green")

    try:
        asyncio.run(
            collect_views(
                bus, collector, patience_s=_PATIENCE_S, taken=taken, hint=lambda text: console.print(f"  … {text}")
            )
        )
    except (KeyboardInterrupt, BusError) as error:
        # A rig that stops sending does not take with it what was seen; too few views are refused with what to do.
        if not collector.views:
            raise
        console.print(f"ended with {len(collector.views)} views{f': {error}' if str(error) else ''}")
