"""`rhot export`: a recording as tables, as an animation, or for a viewer of robots' data."""

from __future__ import annotations

import dataclasses
import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from itertools import chain
from pathlib import Path

import click
import numpy as np
from rich.console import Console

from rhot.arrays import FloatArray
from rhot.atomic_file import replacing
from rhot.cli.options import FiniteRange, rig_folder_option
from rhot.errors import ConfigError
from rhot.geometry.rotations import inverse
from rhot.messages import Event, Message, Side, Space
from rhot.plugins import load_library
from rhot.recording.attached import rig_of
from rhot.recording.messages import RecordedMessages, joined_parts
from rhot.rig import CameraCalibration, Rig, load_rig
from rhot.rig.folder import write_text_atomic
from rhot.take import Take
from rhot.take.reading import load
from rhot_tools.export.archives import subject_of, write_bids, write_mat, write_netcdf, write_nwb
from rhot_tools.export.bvh import RIG_TO_FILE, STAGE_TO_FILE, bvh_text
from rhot_tools.export.columns import tables
from rhot_tools.export.frames import (
    MOST_FRAMES,
    coordinates_deg,
    frames_of,
    mot_text,
    real_rate_hz,
    trc_text,
    write_c3d,
)
from rhot_tools.export.gltf import gltf_document
from rhot_tools.export.isaac import write_isaac
from rhot_tools.export.osim import osim_text
from rhot_tools.export.poses import ExportedMotion, motions
from rhot_tools.export.rerun_file import write_rerun
from rhot_tools.export.skeleton_motion import skeleton_motion
from rhot_tools.export.table_files import write_csv, write_parquet
from rhot_tools.recordings.beside import StoredPicture, pictures_beside, stored_pictures
from rhot_tools.trial.verdict import judged_recording

# Which frame an export stands in: the stage (y up, origin on the floor) where it is known, else the rig's own.
#
# A recording of `rhot record` holds what was published on `rhot/space/stage`; the last of it counts. Else the rig
# folder knows, the one that is named or the one inside the recording.

STAGE_KEY = "rhot/space/stage"
NO_STAGE = (
    "no floor is known: the file is in the rig's own frame, whose axes are those of the first camera; `rhot calibrate "
    "stage` finds the floor, --rig names a rig folder that knows it"
)


def stage_of(messages: Iterable[tuple[str, Message]], rig: Rig | None) -> FloatArray | None:
    """Return T_stage_rig (4, 4), metres; None where nobody knows it."""
    spaces = [message for key, message in messages if key == STAGE_KEY and isinstance(message, Space)]
    if spaces:
        return inverse(np.array(spaces[-1].T_rig_space))
    if rig is not None and rig.stage is not None:
        return inverse(rig.stage.T_rig_stage.matrix)
    return None


# The files of `rhot export` that hold motion, in the stage where the floor is known.


@dataclass(frozen=True, slots=True)
class MotionTargets:
    """What to write; None = not asked for.

    Attributes:
        bvh, trc, mot, osim, c3d, gltf, isaac: files.
        bvh_name: which motion goes into the BVH file, such as `hand_left` or `body`.
        rate_hz: frames per second; None = as recorded.
    """

    bvh: Path | None
    trc: Path | None
    mot: Path | None
    osim: Path | None
    c3d: Path | None
    gltf: Path | None
    isaac: Path | None
    bvh_name: str | None
    rate_hz: float | None

    @property
    def any(self) -> bool:
        """Whether there is something to write."""
        files = (self.bvh, self.trc, self.mot, self.osim, self.c3d, self.gltf, self.isaac)
        return any(file is not None for file in files)


def write_motion_files(
    targets: MotionTargets, found: dict[str, ExportedMotion], *, in_stage: bool, events: Sequence[Event] = ()
) -> None:
    """Write motions and say what was written.

    Args:
        targets: what to write.
        found: the motions by name, in the stage or in the rig frame.
        in_stage: which of the two.
        events: marked moments.

    Raises:
        ConfigError: there is nothing to write, or a file cannot be written.
    """
    if targets.bvh is not None:
        _write_bvh(targets.bvh, _chosen(found, targets.bvh_name), targets.rate_hz, in_stage=in_stage)
    if targets.isaac is not None:
        count = write_isaac(targets.isaac, found)
        click.echo(f"{targets.isaac}: {count} poses, metres")
    every = [motion for _, motion in sorted(found.items())]
    if targets.osim is not None:
        write_text_atomic(targets.osim, osim_text(every))
        click.echo(f"{targets.osim}: OpenSim model of {', '.join(each.name for each in every if each.is_hand)}, metres")
    lab = (targets.trc, targets.mot, targets.c3d, targets.gltf)
    if any(file is not None for file in lab) and not every:
        raise ConfigError("the recording holds no hand, body, foot, object or head to export")
    if targets.gltf is not None:
        document = gltf_document(every, "stage" if in_stage else "rig")
        with replacing(targets.gltf) as part:
            part.write_bytes(document.binary() if targets.gltf.suffix.lower() == ".glb" else document.text().encode())
        click.echo(f"{targets.gltf}: {', '.join(motion.name for motion in every)}, metres")
    if not any(file is not None for file in lab[:3]):
        return
    frames = frames_of(every, targets.rate_hz, events)
    told = f"{len(frames.t_s)} frames at {frames.rate_hz:.3f} Hz"
    if targets.trc is not None:
        write_text_atomic(targets.trc, trc_text(frames, targets.trc.name))
        click.echo(f"{targets.trc}: {len(frames.markers)} markers, {told}, metres")
    if targets.mot is not None:
        if not frames.angles:
            raise ConfigError("--mot: the recording holds no joint angles; hands and bodies have them")
        write_text_atomic(targets.mot, mot_text(frames, targets.mot.stem))
        click.echo(f"{targets.mot}: {len(coordinates_deg(frames))} angles, {told}, degrees")
    if targets.c3d is not None:
        files = write_c3d(targets.c3d, frames, y_up=in_stage)
        parts = f", in {len(files)} files of at most {MOST_FRAMES} frames" if len(files) > 1 else ""
        click.echo(f"{files[0]}: {len(frames.markers)} markers, {told}, millimetres{parts}")


def _chosen(found: dict[str, ExportedMotion], name: str | None) -> ExportedMotion:
    """Return the motion for the BVH file: the one that was named, else the only hand, else the only thing."""
    names = ", ".join(sorted(found)) or "nothing that moves"
    if name is not None:
        if name not in found:
            raise ConfigError(f"the recording holds no complete pose of {name}; there is {names}")
        return found[name]
    hands = [each for each, motion in found.items() if motion.is_hand]
    if len(hands) > 1:
        raise ConfigError("the recording holds both hands; choose one with --hand left or --hand right")
    if hands:
        return found[hands[0]]
    if len(found) == 1:
        return next(iter(found.values()))
    raise ConfigError(f"the recording holds no complete pose of a hand, but {names}; choose with --bvh-of")


def _write_bvh(file: Path, motion: ExportedMotion, rate_hz: float | None, *, in_stage: bool) -> None:
    skeleton = skeleton_motion(motion, rate_hz)
    write_text_atomic(file, bvh_text(skeleton, STAGE_TO_FILE if in_stage else RIG_TO_FILE))
    console = Console(soft_wrap=True, markup=False)
    console.print(f"{file}: {motion.name}, {len(skeleton.root)} frames of {1e3 * skeleton.interval_s:.3f} ms, cm")
    if rate_hz is None:
        error_mm = 1e3 * float(np.linalg.norm(skeleton.positions() - motion.positions, axis=-1).max())
        console.print(f"joints within {error_mm:.4f} mm of the recording, constant bone lengths")
        if skeleton.timing_error_s > skeleton.interval_s / 2.0:
            console.print(
                f"poses came unevenly: up to {1e3 * skeleton.timing_error_s:.1f} ms from the time of their frame; "
                "--fps 60 puts them at their times",
                style="yellow",
            )
    if motion.incomplete:
        console.print(f"{motion.incomplete} poses lack joints and are left out", style="yellow")


_FILE = click.Path(path_type=Path, dir_okay=False)


def _write_tables(parts: Sequence[RecordedMessages], csv_folder: Path | None, parquet_folder: Path | None) -> None:
    made = tables(chain.from_iterable(parts))
    if not made:
        raise ConfigError(f"{parts[0].path}: holds no hand, body, foot, points, object or markers to export")
    written = [] if csv_folder is None else write_csv(csv_folder, made)
    written += [] if parquet_folder is None else write_parquet(parquet_folder, made)
    rows = {table.name: len(table.order()) for table in made}
    for path in written:
        click.echo(f"{path}: {rows[path.stem]} rows")


def _write_archives(
    files: Sequence[Path],
    rig: Rig | None,
    nwb: Path | None,
    bids: Path | None,
    bids_name: str | None,
    mat: Path | None,
    netcdf: Path | None,
    rate_hz: float | None,
) -> None:
    take = load(*files)
    if "stage" not in take.spaces and rig is not None and rig.stage is not None:
        take = dataclasses.replace(take, spaces={**take.spaces, "stage": np.array(rig.stage.T_rig_stage.matrix)})
    if "stage" in take.spaces:
        take = take.in_frame("stage")
    plain = re.sub(r"[^A-Za-z0-9]", "", files[0].stem) or "rhot"
    bids_name = bids_name or f"sub-01_task-{plain}"
    if nwb is not None:
        subject = subject_of(bids_name)
        click.echo(f"{nwb}: {write_nwb(nwb, take, files[0].stem, subject)} tracks, metres, radians")
        click.echo(f"{nwb}: subject {subject}; archives also ask for age and sex: add them with pynwb")
    if mat is not None:
        click.echo(f"{mat}: {write_mat(mat, take)} tracks, metres, radians")
    if netcdf is not None:
        click.echo(f"{netcdf}: {write_netcdf(netcdf, take)} groups, metres")
    if bids is not None:
        rate_hz = rate_hz or _rate_of(take)
        file = write_bids(bids, take, bids_name, rate_hz)
        click.echo(f"{file}: at {rate_hz:g} Hz, metres, radians")


def _rate_of(take: Take) -> float:
    """Return the rate of the fastest track, whole hertz."""
    return float(max((round(real_rate_hz(track.t_ns)) for track in take.tracks.values()), default=1))


def _write_viewer_files(
    parts: Sequence[RecordedMessages],
    cameras: Mapping[str, CameraCalibration],
    foxglove_file: Path | None,
    rerun_file: Path | None,
) -> None:
    if foxglove_file is not None:
        write_foxglove = load_library("rhot_tools.export.foxglove", "--foxglove", "foxglove").write_foxglove
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
@click.option("--osim", type=_FILE, help="OpenSim model of the recorded hands, for its inverse kinematics on --trc.")
@click.option("--c3d", type=_FILE, help="Markers for Mokka, Visual3D, MATLAB and others.")
@click.option("--nwb", type=_FILE, help="Neurodata Without Borders, hands by ndx-pose.")
@click.option("--bids", type=click.Path(path_type=Path, file_okay=False), help="Dataset of Motion-BIDS to add to.")
@click.option(
    "--bids-name",
    metavar="NAME",
    help="With --bids: sub-<label>[_ses-<label>]_task-<label>[_run-<index>]; the subject of --nwb.",
)
@click.option("--mat", type=_FILE, help="Structs for MATLAB.")
@click.option("--netcdf", type=_FILE, help="netCDF, a group for each kind of thing.")
@click.option("--isaac", type=_FILE, help="MCAP file of hands for NVIDIA Isaac Teleop.")
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
@rig_folder_option("Rig folder that knows the floor, where the recording does not.")
def export(
    files: tuple[Path, ...],
    csv_folder: Path | None,
    parquet_folder: Path | None,
    bvh: Path | None,
    gltf: Path | None,
    trc: Path | None,
    mot: Path | None,
    osim: Path | None,
    c3d: Path | None,
    nwb: Path | None,
    bids: Path | None,
    bids_name: str | None,
    mat: Path | None,
    netcdf: Path | None,
    isaac: Path | None,
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

    Motion (glTF, BVH, TRC, MOT, OSIM, C3D, Isaac), in the stage: y up, origin on the floor, as the recording or the rig
    folder knows it. Time 0 is the first pose, but for Isaac. glTF, TRC and Isaac are in metres, BVH in centimetres, C3D
    in millimetres, MOT in degrees. docs/export.md says what to open them with.

    Files for archives (NWB, Motion-BIDS, MATLAB, netCDF) hold everything with its standard deviations and marked
    events, in the stage where it is known, else in the rig frame; BIDS at a steady rate, that of --fps.

    Files for viewers show hands, points, objects, cameras and markers, over the pictures where `rhot record --frames`
    wrote them beside the recording.

    \b
    rhot export grasp.mcap --csv tables
    rhot export grasp.mcap --gltf grasp.glb --bvh grasp.bvh --fps 60
    rhot export grasp.mcap --trc grasp.trc --mot grasp.mot --osim grasp.osim
    rhot export grasp.mcap --foxglove grasp.foxglove.mcap --rerun grasp.rrd
    """
    bvh_name = bvh_of or (None if side is None else f"hand_{side}")
    targets = MotionTargets(bvh, trc, mot, osim, c3d, gltf, isaac, bvh_name, rate_hz)
    archives = (nwb, bids, mat, netcdf)
    others = (csv_folder, parquet_folder, foxglove_file, rerun_file, *archives)
    if not targets.any and all(each is None for each in others):
        raise click.UsageError(
            "say what to write: --csv, --parquet, --gltf, --bvh, --trc, --mot, --osim, --c3d, --nwb, --bids, --mat, "
            "--netcdf, --isaac, --foxglove or --rerun"
        )
    if gltf is not None and gltf.suffix.lower() not in (".glb", ".gltf"):
        raise ConfigError(f"--gltf {gltf}: its name ends in .glb (binary) or .gltf (text)")
    if len(files) > 1 and not join:
        raise click.UsageError("several files: --join makes one of the parts of a recording; export others one by one")
    parts = joined_parts(files) if join else [RecordedMessages(files[0])]
    errors = Console(stderr=True, soft_wrap=True, markup=False)
    rig = rig_of(parts) if rig_path is None else load_rig(rig_path)
    if csv_folder is not None or parquet_folder is not None:
        _write_tables(parts, csv_folder, parquet_folder)
    if targets.any:
        T_stage_rig = stage_of(chain.from_iterable(parts), rig)
        found = motions(chain.from_iterable(parts), measured=measured)
        if T_stage_rig is None:
            errors.print(NO_STAGE, style="yellow")
        else:
            found = {name: motion.moved(T_stage_rig) for name, motion in found.items()}
        events = [message for _, message in chain.from_iterable(parts) if isinstance(message, Event)]
        write_motion_files(targets, found, in_stage=T_stage_rig is not None, events=events)
    if any(each is not None for each in archives):
        _write_archives(files, rig, nwb, bids, bids_name, mat, netcdf, rate_hz)
    _write_viewer_files(parts, {} if rig is None else rig.cameras, foxglove_file, rerun_file)
    verdict = judged_recording(parts, rig)
    verdict.print(errors)
    return verdict.exit_code
