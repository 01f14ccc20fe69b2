"""`rhot record`: everything that a running rig publishes, into an MCAP file, and its pictures beside it."""

from __future__ import annotations

import asyncio
import contextlib
import sys
import time
from collections.abc import AsyncIterator, Callable, Mapping
from pathlib import Path

import click
from rich.console import Console
from rich.live import Live
from rich.markup import escape
from rich.table import Table

from rhot.bus import CONNECT_S, Bus
from rhot.cli.options import DEFAULT_RIG, FiniteRange, bus_options, rig_option, tool_bus
from rhot.errors import ConfigError
from rhot.recording.attached import attached_rig
from rhot.recording.feet_tables import HEAD_FILE, FeetTables
from rhot.recording.mcap.gaps import Tally
from rhot.recording.mcap.session import record as record_session
from rhot.recording.mcap.session import (
    record_motion,
    record_pictures,
    subscribe,
    subscribe_motion,
    subscribe_pictures,
)
from rhot.recording.mcap.writer import McapWriter, attachments_of, rig_files
from rhot.recording.messages import RecordedMessages
from rhot.recording.model import MOST_CAMERAS
from rhot.recording.picture_folder import PictureFolder
from rhot.report.html import figures_table
from rhot.rig import BusConfig
from rhot.service.configuration import fetch_rig_files
from rhot.service.stop import Stop, install_stop
from rhot.text import printable
from rhot_tools.trial.verdict import judged_recording

_SWITCH_S = 0.0005
_MOST_ROWS = 60
_MOST_NAMED = 3
_BEFORE_START = ("rhot/status/", "rhot/space/", "rhot/control")
"""Keys that bring something without a session, too."""
_LONGEST_SHOWN = 100


def _target(out: Path) -> Path:
    """Return the file to write: what was named, or a name with date and time in a folder that was named."""
    if out.is_dir() or not out.suffix:
        try:
            out.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise ConfigError(f"--out {out}: cannot be made: {error.strerror or error}") from error
        return out / f"rhot-{time.strftime('%Y%m%d-%H%M%S')}.mcap"
    if out.suffix != ".mcap":
        raise ConfigError(f"--out {out}: the name of a recording ends in .mcap; without an ending it is a folder")
    if not out.parent.is_dir():
        raise ConfigError(f"--out {out}: the folder {out.parent} does not exist; make it, or choose another")
    return out


def counts_table(tally: Tally, title: str, elapsed_s: float) -> Table:
    """Return what was recorded so far, one row a key."""
    table = figures_table("key", "messages", "per s", "kB", "lost", "restarts", title=title)
    for key, count in sorted(tally.keys.items())[:_MOST_ROWS]:
        lost = f"[red]{count.lost}[/]" if count.lost else "0"
        rate = count.messages / elapsed_s
        kilobytes = f"{count.bytes / 1e3:.0f}"
        table.add_row(
            escape(printable(key, _LONGEST_SHOWN)),
            str(count.messages),
            f"{rate:.1f}",
            kilobytes,
            lost,
            str(count.restarts),
        )
    if len(tally.keys) > _MOST_ROWS:
        table.add_row(f"and {len(tally.keys) - _MOST_ROWS} more keys")
    return table


@contextlib.asynccontextmanager
async def _taking_pictures(
    config: BusConfig, folder: PictureFolder, stop: Stop, console: Console
) -> AsyncIterator[None]:
    """Record pictures during the block, over a session of their own, so that messages do not queue behind them."""
    async with await Bus.open(config, timeout_s=CONNECT_S) as bus:
        mailbox, motion = subscribe_pictures(bus), subscribe_motion(bus)
        # The tables are closed first: a folder is complete when all of it is written.
        with folder, FeetTables(lambda: folder.depth_camera) as tables:
            storing = [
                asyncio.create_task(record_pictures(mailbox, folder)),
                asyncio.create_task(record_motion(motion, tables)),
            ]
            # A disk that is full ends the whole recording.
            for task in storing:
                task.add_done_callback(lambda _: stop.requested.set())
            try:
                yield
            finally:
                for each in (mailbox, *motion):
                    each.close()
                invalid = sum(await asyncio.gather(*storing))
    for name, count in sorted(folder.counts.items()):
        lost = f", [red]{count.lost} lost on the way[/]" if count.lost else ""
        left_out = f", [red]{count.left_out} left out: not later than the one before, or a time that cannot be[/]"
        written = f"{count.messages - count.left_out} pictures, {count.bytes / 1e6:.1f} MB"
        console.print(f"{escape(str(folder.path / name))}: {written}{lost}{left_out if count.left_out else ''}")
    _print_tables(folder, tables, console)
    if folder.refused:
        console.print(
            f"[red]{folder.refused} pictures are left out: their cameras' names cannot be folders, or there are more "
            f"than {MOST_CAMERAS}; does a stranger publish on this bus? `rhot doctor` says what is open[/]"
        )
    if mailbox.overwritten:
        console.print(f"[red]{mailbox.overwritten} pictures were lost because the disk was too slow[/]")
    if invalid:
        console.print(f"[red]{invalid} pictures, poses or samples were not valid and are left out[/]")
    if not folder.counts:
        console.print("[yellow]no camera sent pictures: do its capture services run, and is the rig started?[/]")


def _print_tables(folder: PictureFolder, tables: FeetTables, console: Console) -> None:
    """Say what was recorded of the feet beside pictures, and what `rhot process` will miss."""
    place = folder.depth_camera
    if place is None:
        return
    for name, rows in sorted(tables.rows.items()):
        console.print(f"{escape(str(place / name))}: {rows} rows")
    if tables.left_out:
        console.print(
            f"[red]{tables.left_out} rows are left out: not later than the one before, or a time that cannot be[/]"
        )
    if HEAD_FILE not in tables.rows:
        console.print(
            "[yellow]no measured pose of the head came, so that the pictures of the feet cannot be tracked: does "
            "`rhot objects` run?[/]"
        )


Opened = Callable[[Mapping[str, bytes]], tuple[McapWriter, PictureFolder | None]]


async def _record(
    config: BusConfig, attachments: Mapping[str, bytes], opened: Opened, duration_s: float | None
) -> list[Path]:
    """Record, say what was recorded, and return the files."""
    stop = install_stop()
    # Arrivals are stamped on Zenoh's thread, which must not wait 5 ms for the one that writes to give way.
    sys.setswitchinterval(_SWITCH_S)
    tally = Tally()
    console = Console(stderr=True, soft_wrap=True)
    # The router first: where none answers, no empty file is left behind.
    async with await Bus.open(config, timeout_s=CONNECT_S) as bus, contextlib.AsyncExitStack() as stack:
        carried = attachments or attachments_of(await fetch_rig_files(bus))
        if not carried:
            console.print("[yellow]no rig folder here, and the rig tells none: only messages are recorded[/]")
        writer, folder = opened(carried)
        with writer:
            if folder is not None:
                await stack.enter_async_context(_taking_pictures(config, folder, stop, console))
            begun = time.monotonic()

            def summary() -> Table:
                elapsed_s = time.monotonic() - begun
                megabytes = writer.written_bytes / 1e6
                return counts_table(
                    tally, f"{escape(str(writer.files[-1]))}: {elapsed_s:.1f} s, {megabytes:.1f} MB", elapsed_s
                )

            mailbox = subscribe(bus)
            console.print(f"recording to {escape(str(writer.files[-1]))}, Ctrl-C ends")
            with Live(console=Console(stderr=True), auto_refresh=False, transient=True) as live:

                def show() -> None:
                    if live.console.is_terminal:
                        live.update(summary(), refresh=True)

                await record_session(mailbox, writer, tally, stop.requested, on_beat=show, duration_s=duration_s)
    Console().print(summary())
    if len(writer.files) > 1:
        console.print(f"{len(writer.files)} files, the first is {escape(str(writer.files[0]))}")
    for remark in remarks(tally, mailbox.overwritten):
        console.print(remark)
    return writer.files


def remarks(tally: Tally, overwritten: int) -> list[str]:
    """Return what is wrong with a recording, as markup; `overwritten`: samples that were not written in time."""
    found = []
    if overwritten:
        found.append(f"[red]{overwritten} samples were lost because the disk was too slow[/]")
    if tally.left_out:
        found.append(
            f"[red]{tally.left_out} samples on more keys than a rig has are left out; does a stranger publish on this "
            "bus? `rhot doctor` says what is open[/]"
        )
    if tally.lost:
        found.append(f"[red]{tally.lost} samples were lost between publisher and recorder: is the network full?[/]")
    shared = [escape(printable(key, _LONGEST_SHOWN)) for key, count in sorted(tally.keys.items()) if count.shared]
    if shared:
        names = ", ".join(shared[:_MOST_NAMED])
        found.append(f"[red]{names}: two publishers at once; does a service run twice? (`rhot status`)[/]")
    if all(key.startswith(_BEFORE_START) for key in tally.keys):
        found.append("[yellow]nothing that moves was published: is the rig started (`rhot start`)?[/]")
    return found


@click.command()
@click.option(
    "--out",
    "out_path",
    type=click.Path(path_type=Path),
    default=Path("recordings"),
    show_default=True,
    help="File to write (its name ends in .mcap), or a folder that gets a file named after date and time.",
)
@click.option("--duration", "duration_s", type=FiniteRange(min=0.1), help="Stop after this many seconds.")
@click.option(
    "--max-mb",
    type=FiniteRange(min=0.1),
    help="Start a new file whenever one has this many megabytes; their names end in -001, -002, ...",
)
@click.option(
    "--frames",
    is_flag=True,
    help="Record the cameras' pictures too, in a folder of the same name beside the file.",
)
@rig_option
@bus_options
def record(
    out_path: Path,
    duration_s: float | None,
    max_mb: float | None,
    frames: bool,
    rig_path: Path,
    connect: tuple[str, ...],
    namespace: str | None,
) -> int:
    """Record everything that a running rig publishes into an MCAP file, until Ctrl-C.

    Every message is kept as it was sent, with its time, and the settings of the rig go with it: those of --rig, else
    those of the running rig. `rhot replay`
    puts a recording back on the bus, `rhot export` makes tables and animations of it, and any MCAP tool opens it.

    With --frames the capture services also send every image that they process, as JPEG of quality 90, after the
    messages and only during a recording; the feet service sends colour and depth of its camera, and the ankles'
    sensors. `rhot process` tracks such a folder again.

    At the end it says whether the trial can be used, and why not. The exit code is 1 if it cannot.

    \b
    rhot record                                until Ctrl-C, into recordings/
    rhot record --out grasp.mcap --duration 30
    rhot record --out grasp.mcap --frames      pictures in grasp/left, grasp/right, grasp/feet
    """
    config = tool_bus(rig_path, connect, namespace)
    attachments = rig_files(rig_path) if rig_path.is_dir() else {}
    if not attachments and rig_path != DEFAULT_RIG:
        raise ConfigError(f"--rig {rig_path} holds no settings; without --rig those of the running rig are recorded")
    about = {"connect": ",".join(config.connect), "namespace": config.namespace, "rig": str(rig_path.resolve())}

    def opened(carried: Mapping[str, bytes]) -> tuple[McapWriter, PictureFolder | None]:
        target = _target(out_path)
        folder = PictureFolder(target.with_suffix(""), f"messages: {target.name}") if frames else None
        writer = McapWriter(
            target,
            now_ns=time.time_ns(),
            max_bytes=None if max_mb is None else round(max_mb * 1e6),
            attachments=carried,
            about=about,
        )
        return writer, folder

    files = asyncio.run(_record(config, attachments, opened, duration_s))
    # Read back from the disk: what was recorded is judged, not what was sent.
    parts = [RecordedMessages(file) for file in files]
    with contextlib.ExitStack() as stack:
        carried = parts[0].attachments
        rig = stack.enter_context(attached_rig(carried, parts[0].path)) if carried else None
        verdict = judged_recording(parts, rig)
    verdict.print(Console(stderr=True, soft_wrap=True))
    return verdict.exit_code
