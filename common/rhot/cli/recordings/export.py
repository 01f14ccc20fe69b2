"""`rhot export`: a recording as tables, as an animation, or for a viewer of robots' data."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import chain
from pathlib import Path

import click
from rich.console import Console

from rhot.cli.options import FiniteRange
from rhot.cli.recordings.motion_files import MotionTargets, write_motion_files
from rhot.errors import ConfigError
from rhot.export.columns import tables
from rhot.export.poses import motions
from rhot.export.rerun_file import write_rerun
from rhot.export.source import RecordedMessages, joined_parts
from rhot.export.stage_axes import NO_STAGE, stage_of
from rhot.export.table_files import write_csv, write_parquet
from rhot.messages import Side
from rhot.recording.mcap.beside import StoredPicture, attached_rig, pictures_beside, stored_pictures
from rhot.rig import CameraCalibration, Rig, load_rig
from rhot.trial.verdict import judged_recording

_FILE = click.Path(path_type=Path, dir_okay=False)


def _attached_rig(parts: Sequence[RecordedMessages]) -> Rig | None:
    """Return the rig that a recording has attached; None where it has none."""
    for part in parts:
        if part.attachments:
            with attached_rig(part.attachments, part.path) as rig:
                return rig
    return None


def _write_tables(parts: Sequence[RecordedMessages], csv_folder: Path | None, parquet_folder: Path | None) -> None:
    made = tables(chain.from_iterable(parts))
    if not made:
        raise ConfigError(f"{parts[0].path}: holds no hand, body, foot, points, object or markers to export")
    written = [] if csv_folder is None else write_csv(csv_folder, made)
    written += [] if parquet_folder is None else write_parquet(parquet_folder, made)
    rows = {table.name: len(table.order()) for table in made}
    for path in written:
        click.echo(f"{path}: {rows[path.stem]} rows")


def _write_viewer_files(
    parts: Sequence[RecordedMessages],
    cameras: Mapping[str, CameraCalibration],
    foxglove_file: Path | None,
    rerun_file: Path | None,
) -> None:
    if foxglove_file is not None:
        try:
            from rhot.export.foxglove.file import write_foxglove  # noqa: PLC0415  # its extra may be absent
        except ModuleNotFoundError as error:
            raise ConfigError(
                f"--foxglove needs the Python module {error.name}; pip install 'rhot[foxglove]'"
            ) from error
        topics = write_foxglove(foxglove_file, chain.from_iterable(parts), dict(cameras), _pictures(parts))
        click.echo(f"{foxglove_file}: {sum(topics.values())} messages on {len(topics)} topics")
    if rerun_file is not None:
        count = write_rerun(rerun_file, chain.from_iterable(parts), dict(cameras), _pictures(parts))
        click.echo(f"{rerun_file}: {count} messages")


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
@click.option("--bvh", type=_FILE, help="BVH animation of one hand, or of what --bvh-of names.")
@click.option("--gltf", type=_FILE, help="Animated glTF scene, .glb or .gltf, for Blender, engines and browsers.")
@click.option("--trc", type=_FILE, help="Markers for OpenSim.")
@click.option("--mot", type=_FILE, help="Joint angles for OpenSim.")
@click.option("--c3d", type=_FILE, help="Markers for Mokka, Visual3D, MATLAB and others.")
@click.option(
    "--foxglove",
    "foxglove_file",
    type=click.Path(path_type=Path, dir_okay=False),
    help="MCAP file for Foxglove and Lichtblick.",
)
@click.option("--rerun", "rerun_file", type=click.Path(path_type=Path, dir_okay=False), help="RRD file for Rerun.")
@click.option("--hand", "side", type=click.Choice(["left", "right"]), help="With --bvh: which hand, if there are both.")
@click.option("--bvh-of", metavar="NAME", help="With --bvh: body, foot_left, object_cup, … in place of a hand.")
@click.option(
    "--fps",
    "rate_hz",
    type=FiniteRange(1, 1000),
    help="Frames per second of BVH, TRC, MOT and C3D, interpolated.  [default: the recorded rate; BVH: one frame per "
    "recorded pose]",
)
@click.option("--join", is_flag=True, help="The files are parts of one recording of `rhot record --max-mb`.")
@click.option("--measured", is_flag=True, help="Leave out poses that are only predicted; not with tables and viewers.")
@click.option(
    "--rig",
    "rig_path",
    type=click.Path(path_type=Path, file_okay=False),
    help="Rig folder that knows the floor, where the recording does not.",
)
def export(
    files: tuple[Path, ...],
    csv_folder: Path | None,
    parquet_folder: Path | None,
    bvh: Path | None,
    gltf: Path | None,
    trc: Path | None,
    mot: Path | None,
    c3d: Path | None,
    foxglove_file: Path | None,
    rerun_file: Path | None,
    side: Side | None,
    bvh_of: str | None,
    rate_hz: float | None,
    join: bool,
    measured: bool,
    rig_path: Path | None,
) -> int:
    """Turn a recording into tables, animations, files for labs, or files for Foxglove, Lichtblick and Rerun.

    FILE is an MCAP file of `rhot record`, or JSON Lines of `rhot process`. Parts of one recording need --join.

    Tables (CSV, Parquet), in the rig frame: one for each hand, body, foot, object and camera and one for the points. A
    row is one moment, t_s counts seconds from the first row of any table, t_ns nanoseconds since 1970 on the rig clock;
    lengths are metres, angles radians, quaternions qx qy qz qw.

    Motion (glTF, BVH, TRC, MOT, C3D), in the stage: y up, origin on the floor, as the recording or the rig folder knows
    it. Time 0 is the first pose. TRC and glTF are in metres, BVH in centimetres, C3D in millimetres, MOT in degrees.
    docs/export.md says what to open them with.

    Files for viewers show hands, points, objects, cameras and markers, over the pictures where `rhot record --frames`
    wrote them beside the recording.

    \b
    rhot export grasp.mcap --csv tables
    rhot export grasp.mcap --gltf grasp.glb --bvh grasp.bvh --fps 60
    rhot export grasp.mcap --trc grasp.trc --mot grasp.mot --c3d grasp.c3d
    rhot export grasp.mcap --foxglove grasp.foxglove.mcap --rerun grasp.rrd
    """
    bvh_name = bvh_of or (None if side is None else f"hand_{side}")
    targets = MotionTargets(bvh, trc, mot, c3d, gltf, bvh_name, rate_hz)
    if not targets.any and all(each is None for each in (csv_folder, parquet_folder, foxglove_file, rerun_file)):
        raise click.UsageError(
            "say what to write: --csv, --parquet, --gltf, --bvh, --trc, --mot, --c3d, --foxglove or --rerun"
        )
    if foxglove_file is not None and foxglove_file.resolve() in [file.resolve() for file in files]:
        raise click.UsageError(f"--foxglove {foxglove_file} is the recording itself; choose another name")
    if len(files) > 1 and not join:
        raise click.UsageError("several files: --join makes one of the parts of a recording; export others one by one")
    parts = joined_parts(files) if join else [RecordedMessages(files[0])]
    errors = Console(stderr=True, soft_wrap=True, markup=False)
    for part in parts:
        if part.note:
            errors.print(part.note, style="yellow")
    if csv_folder is not None or parquet_folder is not None:
        _write_tables(parts, csv_folder, parquet_folder)
    rig = _attached_rig(parts) if rig_path is None else load_rig(rig_path)
    if targets.any:
        T_stage_rig = stage_of(chain.from_iterable(parts), rig)
        found = motions(chain.from_iterable(parts), measured=measured)
        if T_stage_rig is None:
            errors.print(NO_STAGE, style="yellow")
        else:
            found = {name: motion.moved(T_stage_rig) for name, motion in found.items()}
        write_motion_files(targets, found, in_stage=T_stage_rig is not None)
    _write_viewer_files(parts, {} if rig is None else rig.cameras, foxglove_file, rerun_file)
    invalid = sum(part.invalid for part in parts)
    if invalid:
        errors.print(f"{invalid} messages are not valid and are left out", style="yellow")
    verdict = judged_recording(parts, rig)
    verdict.print(errors)
    return verdict.exit_code
