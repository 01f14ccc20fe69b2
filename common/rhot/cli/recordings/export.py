"""`rhot export`: a recording as tables, as an animation, or for a viewer of robots' data."""

from __future__ import annotations

import tempfile
from collections.abc import Iterable, Sequence
from itertools import chain
from pathlib import Path

import click
import numpy as np
from rich.console import Console

from rhot.errors import ConfigError
from rhot.export.bvh import bvh_text
from rhot.export.columns import tables
from rhot.export.poses import hand_motion
from rhot.export.rerun_file import write_rerun
from rhot.export.skeleton_motion import skeleton_motion
from rhot.export.source import RecordedMessages
from rhot.export.table_files import write_csv, write_parquet
from rhot.messages import Message, Side
from rhot.recording.mcap.beside import StoredPicture, pictures_beside, stored_pictures, unpack_rig
from rhot.rig import CameraCalibration, load_rig
from rhot.rig.folder import write_text_atomic


def _write_bvh(messages: Iterable[tuple[str, Message]], file: Path, side: Side | None, rate_hz: float | None) -> None:
    motion = hand_motion(messages, side)
    skeleton = skeleton_motion(motion, rate_hz)
    write_text_atomic(file, bvh_text(skeleton))
    console = Console(soft_wrap=True)
    console.print(f"{file}: {motion.side} hand, {len(skeleton.root)} frames of {1e3 * skeleton.interval_s:.3f} ms, cm")
    if rate_hz is None:
        error_mm = 1e3 * float(np.linalg.norm(skeleton.positions() - motion.positions, axis=-1).max())
        console.print(f"joints within {error_mm:.4f} mm of the recording, constant bone lengths")
        if skeleton.timing_error_s > skeleton.interval_s / 2.0:
            console.print(
                f"[yellow]poses came unevenly: up to {1e3 * skeleton.timing_error_s:.1f} ms from the time of their "
                "frame; --fps 60 puts them at their times[/]"
            )
    if motion.incomplete:
        console.print(f"[yellow]{motion.incomplete} poses lack joints and are left out[/]")


def _cameras(parts: Sequence[RecordedMessages]) -> dict[str, CameraCalibration]:
    """Return the cameras of the rig that a recording has attached; none where it has none."""
    for part in parts:
        if part.attachments:
            with tempfile.TemporaryDirectory(prefix="rhot-export-") as folder:
                return dict(load_rig(unpack_rig(part.attachments, Path(folder), part.path)).cameras)
    return {}


def _pictures(parts: Sequence[RecordedMessages]) -> list[StoredPicture]:
    beside = (pictures_beside(part.path) for part in parts)
    # Parts of one recording share a folder.
    folders = {recording.path: recording for recording in beside if recording is not None}
    return [picture for recording in folders.values() for picture in stored_pictures(recording)]


@click.command()
@click.argument("files", metavar="FILE...", nargs=-1, required=True, type=click.Path(path_type=Path, dir_okay=False))
@click.option("--csv", "csv_folder", type=click.Path(path_type=Path, file_okay=False), help="Folder for CSV tables.")
@click.option(
    "--parquet", "parquet_folder", type=click.Path(path_type=Path, file_okay=False), help="Folder for Parquet tables."
)
@click.option("--bvh", "bvh_file", type=click.Path(path_type=Path, dir_okay=False), help="BVH animation of one hand.")
@click.option(
    "--foxglove",
    "foxglove_file",
    type=click.Path(path_type=Path, dir_okay=False),
    help="MCAP file for Foxglove and Lichtblick.",
)
@click.option("--rerun", "rerun_file", type=click.Path(path_type=Path, dir_okay=False), help="RRD file for Rerun.")
@click.option("--hand", "side", type=click.Choice(["left", "right"]), help="With --bvh: which hand, if there are both.")
@click.option(
    "--fps",
    "rate_hz",
    type=click.FloatRange(1, 1000),
    help="Frames per second of the animation, interpolated.  [default: one frame per recorded pose]",
)
def export(
    files: tuple[Path, ...],
    csv_folder: Path | None,
    parquet_folder: Path | None,
    bvh_file: Path | None,
    foxglove_file: Path | None,
    rerun_file: Path | None,
    side: Side | None,
    rate_hz: float | None,
) -> None:
    """Turn a recording into tables (CSV, Parquet), an animation (BVH), or files for Foxglove, Lichtblick and Rerun.

    FILE is an MCAP file of `rhot record`, or JSON Lines of `rhot process`; several parts of one recording are joined.
    There is one table for each hand, object and camera and one for the points: a row is one moment, t_s counts seconds
    from the first row of any table, t_ns nanoseconds since 1970 on the rig clock; lengths are metres, angles radians,
    quaternions qx qy qz qw. The animation is a skeleton whose root is the wrist, in centimetres with Y up; Blender
    opens it with File > Import > Motion Capture (scale 0.01). Files for viewers show hands, points, objects, cameras
    and markers, over the pictures where `rhot record --frames` wrote them beside the recording.

    \b
    rhot export grasp.mcap --csv tables
    rhot export grasp.mcap --bvh grasp.bvh --fps 60
    rhot export grasp.mcap --foxglove grasp.foxglove.mcap --rerun grasp.rrd
    """
    if all(target is None for target in (csv_folder, parquet_folder, bvh_file, foxglove_file, rerun_file)):
        raise click.UsageError("say what to write: --csv, --parquet, --bvh, --foxglove or --rerun")
    if foxglove_file is not None and foxglove_file.resolve() in [file.resolve() for file in files]:
        raise click.UsageError(f"--foxglove {foxglove_file} is the recording itself; choose another name")
    parts = [RecordedMessages(file) for file in files]
    errors = Console(stderr=True, soft_wrap=True)
    for part in parts:
        if part.note:
            errors.print(f"[yellow]{part.note}[/]")
    if csv_folder is not None or parquet_folder is not None:
        made = tables(chain.from_iterable(parts))
        if not made:
            raise ConfigError(f"{files[0]}: holds no hand, points, object or markers to export")
        written = [] if csv_folder is None else write_csv(csv_folder, made)
        written += [] if parquet_folder is None else write_parquet(parquet_folder, made)
        rows = {table.name: len(table.order()) for table in made}
        for path in written:
            click.echo(f"{path}: {rows[path.stem]} rows")
    if bvh_file is not None:
        _write_bvh(chain.from_iterable(parts), bvh_file, side, rate_hz)
    if foxglove_file is not None:
        try:
            from rhot.export.foxglove.file import write_foxglove  # noqa: PLC0415  # its extra may be absent
        except ModuleNotFoundError as error:
            raise ConfigError(
                f"--foxglove needs the Python module {error.name}; pip install 'rhot[foxglove]'"
            ) from error
        written_topics = write_foxglove(foxglove_file, chain.from_iterable(parts), _cameras(parts), _pictures(parts))
        click.echo(f"{foxglove_file}: {sum(written_topics.values())} messages on {len(written_topics)} topics")
    if rerun_file is not None:
        count = write_rerun(rerun_file, chain.from_iterable(parts), _cameras(parts), _pictures(parts))
        click.echo(f"{rerun_file}: {count} messages")
    invalid = sum(part.invalid for part in parts)
    if invalid:
        errors.print(f"[yellow]{invalid} messages are not valid and are left out[/]")
