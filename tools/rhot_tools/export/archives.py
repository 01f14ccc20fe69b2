"""Files that archives of science ask for, from the arrays of a take: NWB, Motion-BIDS, MATLAB, netCDF.

Each is written by its own library, which is loaded when it is asked for and comes with `pip install 'rhot[archives]'`.
"""

from __future__ import annotations

import datetime as dt
import importlib
import json
import re
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any, Final

import numpy as np

from rhot import __version__
from rhot.anatomy.skeleton import PARENTS
from rhot.arrays import FloatArray
from rhot.atomic_file import replacing
from rhot.errors import ConfigError
from rhot.plugins import load_library
from rhot.rig.folder import write_text_atomic
from rhot.take import HandTrack, JointTrack, PointTrack, RigidTrack, Take, Track
from rhot.take.tables import confidence

SOFTWARE: Final = "RHOT"
_CONFIDENCE: Final = "1 measured, 0.5 seen by one camera, 0 predicted"


def frame_of(take: Take) -> str:
    """Return what the take's axes are, for people."""
    if take.frame == "stage":
        return "right-handed, y up, -z forward, origin on the floor"
    return "right-handed, x right, y down, z forward of the first camera, origin in that camera"


def start_of(take: Take) -> dt.datetime:
    """Return the time of the take's first sample."""
    return dt.datetime.fromtimestamp(1e-9 * take.start_ns, dt.UTC)


def _require_tracks(take: Take, option: str) -> None:
    if not take.tracks:
        raise ConfigError(f"{option}: the recording holds no hand, point, object, foot or body")


# NWB.


def write_nwb(file: Path, take: Take, name: str, subject: str) -> int:
    """Write a Neurodata Without Borders file with hands as poses of the extension ndx-pose; return how many tracks.

    Args:
        file: to write.
        take: in the frame to write.
        name: of the session.
        subject: label of the person; archives refuse a file without one.

    Raises:
        ConfigError: there is nothing to write, or a library is missing.
    """
    _require_tracks(take, "--nwb")
    pynwb, poses = (load_library(name, "--nwb", "archives") for name in ("pynwb", "ndx_pose"))
    nwb = pynwb.NWBFile(
        session_description=f"motion tracked by {SOFTWARE}",
        identifier=f"{name}-{take.start_ns}",
        session_start_time=start_of(take),
        keywords=["motion capture", "pose estimation"],
        subject=importlib.import_module("pynwb.file").Subject(subject_id=subject, species="Homo sapiens", sex="U"),
    )
    module = nwb.create_processing_module("behavior", "tracked motion")
    where = frame_of(take)
    skeletons = [_add_joints(module, track, where, pynwb, poses) for track in _joint_tracks(take)]
    if skeletons:
        module.add(poses.Skeletons(skeletons=skeletons))
    rigid = [track for track in take.tracks.values() if isinstance(track, PointTrack | RigidTrack)]
    if rigid:
        position = importlib.import_module("pynwb.behavior").Position(name="position")
        module.add(position)
        for each in rigid:
            label = each.name.replace("/", "_")
            position.create_spatial_series(
                name=label, data=each.positions, unit="meters", reference_frame=where, timestamps=each.t,
                description=f"position of {each.name}",
            )  # fmt: skip
            if isinstance(each, RigidTrack):
                module.add(
                    pynwb.TimeSeries(
                        name=f"{label}_orientation", data=each.orientations, unit="1", timestamps=each.t,
                        description="unit quaternions x, y, z, w",
                    )
                )  # fmt: skip
    if take.events:
        table = nwb.create_events_table(name="events", description="marked moments; NaN = uncertainty unknown")
        table.add_column("source", "what marked the moment")
        table.add_column("uncertainty", "of the time, seconds")
        for event in take.events:
            doubt_s = np.nan if event.uncertainty_s is None else event.uncertainty_s
            table.add_row(
                timestamp=1e-9 * (event.t_ns - take.start_ns), annotation=event.label,
                source=event.source, uncertainty=doubt_s,
            )  # fmt: skip
    h5py = importlib.import_module("h5py")
    with replacing(file) as part, h5py.File(part, "w") as opened, pynwb.NWBHDF5IO(file=opened, mode="w") as out:
        out.write(nwb)
    return len(take.tracks)


def _add_joints(module: Any, track: JointTrack, where: str, pynwb: Any, poses: Any) -> Any:
    """Add a hand or body to a processing module: its joints, angles and standard deviations; return its skeleton.

    Args:
        module: of the file.
        track: to add.
        where: what the axes are, for people.
        pynwb, poses: the libraries, which are loaded when asked for.
    """
    label = track.name.replace("/", "_")
    places = {joint: number for number, joint in enumerate(track.joint_names)}
    edges = [(places[p], n) for joint, n in places.items() if (p := PARENTS.get(joint)) in places]
    skeleton = poses.Skeleton(name=label, nodes=list(places), edges=np.array(edges, np.uint8).reshape(-1, 2))
    series: list[Any] = []
    for joint, number in places.items():
        series.append(
            poses.PoseEstimationSeries(
                name=joint,
                description=f"position of {joint}",
                data=track.positions[:, number],
                unit="meters",
                reference_frame=where,
                timestamps=track.t if not series else series[0],
                confidence=confidence(track.state),
                confidence_definition=_CONFIDENCE,
            )
        )
    module.add(
        poses.PoseEstimation(
            name=label,
            pose_estimation_series=series,
            description=f"joints of {track.name} by their names in OpenXR",
            source_software=SOFTWARE,
            source_software_version=__version__,
            skeleton=skeleton,
        )
    )
    for what, about, data, unit, columns in (
        ("angles", "joint angles", track.angles, "radians", track.angle_names),
        ("sigma", "standard deviations of positions", track.sigma, "meters", track.joint_names),
    ):
        module.add(
            pynwb.TimeSeries(
                name=f"{label}_{what}", data=data, unit=unit, timestamps=track.t, comments=", ".join(columns),
                description=about,
            )
        )  # fmt: skip
    return skeleton


def _joint_tracks(take: Take) -> list[JointTrack]:
    return [*take.hands.values(), *((take.body,) if take.body is not None else ())]


# Motion-BIDS.

_BIDS_NAME: Final = re.compile(r"sub-([A-Za-z0-9]+)(_ses-[A-Za-z0-9]+)?_task-([A-Za-z0-9]+)(_run-[0-9]+)?")


def _bids_name(name: str) -> re.Match[str]:
    match = _BIDS_NAME.fullmatch(name)
    if match is None:
        raise ConfigError(f"--bids-name {name}: write sub-01_task-grasp, or sub-01_ses-2_task-grasp_run-1")
    return match


def subject_of(name: str) -> str:
    """Return the label of the person in a name as `write_bids` takes it.

    Raises:
        ConfigError: it is none of BIDS.
    """
    return _bids_name(name)[1]


def write_bids(folder: Path, take: Take, name: str, rate_hz: float) -> Path:
    """Add a recording to a dataset of Motion-BIDS, which is made if it is not there; return the file of its motion.

    Args:
        folder: of the dataset.
        take: in the frame to write.
        name: `sub-<label>[_ses-<label>]_task-<label>[_run-<index>]`.
        rate_hz: of the samples, which are steady.

    Raises:
        ConfigError: the name is none of BIDS, the file is there already, or there is nothing to write.
    """
    _require_tracks(take, "--bids")
    match = _bids_name(name)
    subject, session, task = f"sub-{match[1]}", match[2] or "", match[3]
    motion = folder / subject / session.removeprefix("_") / "motion" if session else folder / subject / "motion"
    before = f"{name.split('_run-', maxsplit=1)[0]}_tracksys-{SOFTWARE}"
    stem = motion / f"{before}{match[4] or ''}"
    file = stem.with_name(f"{stem.name}_motion.tsv")
    if file.exists():
        raise ConfigError(f"{file} is there already; give this trial another --bids-name")
    steady = take.resampled(rate_hz)
    channels, columns = _bids_channels(steady)
    motion.mkdir(parents=True, exist_ok=True)
    _make_dataset(folder, subject)
    description = {
        "TaskName": task,
        "TaskDescription": f"motion tracked by {SOFTWARE}",
        "SamplingFrequency": rate_hz,
        "TrackingSystemName": SOFTWARE,
        "SoftwareVersions": __version__,
        "MotionChannelCount": len(columns),
        "POSChannelCount": sum(row[2] == "POS" for row in channels),
        "ORNTChannelCount": sum(row[2] == "ORNT" for row in channels),
        "JNTANGChannelCount": sum(row[2] == "JNTANG" for row in channels),
        "MISCChannelCount": sum(row[2] == "MISC" for row in channels),
        "TrackedPointsCount": len({row[3] for row in channels}),
        "MissingValues": "n/a",
        "RecordingType": "continuous",
    }
    write_text_atomic(stem.with_name(f"{stem.name}_motion.json"), _json(description))
    heading = "name\tcomponent\ttype\ttracked_point\tunits\treference_frame"
    lines = [heading, *("\t".join((*row, "global")) for row in channels)]
    write_text_atomic(stem.with_name(f"{stem.name}_channels.tsv"), "\n".join(lines) + "\n")
    axes = "RUB" if take.frame == "stage" else "RDF"
    frame = {"RotationRule": "right-hand", "RotationOrder": "n/a", "SpatialAxes": axes, "Description": frame_of(take)}
    levels = {"global": frame}
    about = {"reference_frame": {"Description": "axes of positions and orientations", "Levels": levels}}
    write_text_atomic(stem.with_name(f"{stem.name}_channels.json"), _json(about))
    table = np.column_stack(columns)
    rows = ("\t".join("n/a" if np.isnan(value) else f"{value:.9g}" for value in row) for row in table)
    write_text_atomic(file, "\n".join(rows) + "\n")
    if take.events:
        times = [f"{1e-9 * (event.t_ns - take.start_ns):.6f}\t0\t{event.label}" for event in take.events]
        text = "\n".join(["onset\tduration\ttrial_type", *times]) + "\n"
        write_text_atomic(motion / f"{name}_events.tsv", text)
    return file


def _bids_channels(take: Take) -> tuple[list[tuple[str, str, str, str, str]], list[FloatArray]]:
    """Return name, component, type, tracked point and unit of each channel, and its values."""
    channels, columns = [], []

    def add(point: str, kind: str, unit: str, components: str | tuple[str, ...], values: FloatArray) -> None:
        for index, component in enumerate(components):
            channels.append((f"{point}_{kind}_{component}", component, kind, point, unit))
            columns.append(values[:, index])

    for label, positions, orientations in _placed(take):
        add(label, "POS", "m", "xyz", positions)
        if orientations is not None:
            add(label, "ORNT", "n/a", ("quat_x", "quat_y", "quat_z", "quat_w"), orientations)
    for track in _joint_tracks(take):
        label = track.name.replace("/", "_")
        for index, angle in enumerate(track.angle_names):
            channels.append((f"{label}_{angle}", "n/a", "JNTANG", f"{label}_{angle}", "rad"))
            columns.append(track.angles[:, index])
        for index, joint in enumerate(track.joint_names):
            if np.isfinite(track.sigma[:, index]).any():
                channels.append((f"{label}_{joint}_sigma", "n/a", "MISC", f"{label}_{joint}", "m"))
                columns.append(track.sigma[:, index])
    return channels, columns


def _placed(take: Take) -> Iterator[tuple[str, FloatArray, FloatArray | None]]:
    for track in take.tracks.values():
        label = track.name.replace("/", "_")
        if isinstance(track, JointTrack):
            for index, joint in enumerate(track.joint_names):
                yield f"{label}_{joint}", track.positions[:, index], track.orientations[:, index]
        elif isinstance(track, RigidTrack):
            yield label, track.positions, track.orientations
        elif isinstance(track, PointTrack):
            yield label, track.positions, None


def _make_dataset(folder: Path, subject: str) -> None:
    """Write what belongs to the whole dataset, unless it is there; add the subject."""
    described = folder / "dataset_description.json"
    if not described.exists():
        about = {
            "Name": folder.resolve().name,
            "BIDSVersion": "1.9.0",
            "DatasetType": "raw",
            "GeneratedBy": [{"Name": SOFTWARE, "Version": __version__}],
        }
        write_text_atomic(described, _json(about))
        readme = f"Hands, objects and bodies, tracked by {SOFTWARE}. Describe your study here.\n"
        write_text_atomic(folder / "README", readme)
    people = folder / "participants.tsv"
    known = people.read_text(encoding="utf-8").splitlines() if people.exists() else ["participant_id"]
    if subject not in [line.split("\t")[0] for line in known]:
        known.append("\t".join([subject, *["n/a"] * known[0].count("\t")]))
        write_text_atomic(people, "\n".join(known) + "\n")


def _json(value: Mapping[str, Any]) -> str:
    return json.dumps(value, indent=2) + "\n"


# MATLAB and netCDF.


def write_mat(file: Path, take: Take) -> int:
    """Write a file of MATLAB (version 5): a struct for each track, with the names and shapes of Python's.

    Raises:
        ConfigError: there is nothing to write, or scipy is missing.
    """
    _require_tracks(take, "--mat")
    scipy_io = load_library("scipy.io", "--mat", "archives")
    found: dict[str, Any] = {"frame": take.frame, "start_ns": np.int64(take.start_ns)}
    for name, track in take.tracks.items():
        kind, _, which = name.partition("/")
        struct = _struct(track)
        if which:
            found.setdefault(kind, {})[_matlab_name(which)] = struct
        else:
            found[kind] = struct
    if take.events:
        found["events"] = {
            "t": [1e-9 * (event.t_ns - take.start_ns) for event in take.events],
            "label": np.array([event.label for event in take.events], dtype=object),
        }
    with replacing(file) as part, part.open("wb") as stream:
        scipy_io.savemat(stream, found, do_compression=True, oned_as="column", long_field_names=True)
    return len(take.tracks)


def _struct(track: Track) -> dict[str, Any]:
    struct: dict[str, Any] = {"t": track.t, "t_ns": track.t_ns}
    for name in ("positions", "orientations", "velocities", "covariances", "sigma", "radii", "angles", "angle_sigma"):
        if hasattr(track, name):
            struct[name] = getattr(track, name)
    for name in ("joint_names", "angle_names", "state"):
        if hasattr(track, name):
            struct[name] = np.array(list(getattr(track, name)), dtype=object)
    if isinstance(track, HandTrack):
        struct["landmarks21"] = track.landmarks21()
    return struct


def _matlab_name(name: str) -> str:
    """Return a name that a field of a struct may have."""
    plain = re.sub(r"\W", "_", name)
    return plain if plain[:1].isalpha() else f"n_{plain}"


def write_netcdf(file: Path, take: Take) -> int:
    """Write a netCDF file with a group for hands, points, objects, feet and body each; see `Take.to_xarray`.

    Raises:
        ConfigError: there is nothing to write, or a library is missing.
    """
    _require_tracks(take, "--netcdf")
    for name in ("h5netcdf", "xarray"):
        load_library(name, "--netcdf", "archives")
    groups: list[str] = []
    with replacing(file) as part:
        for kind in ("hands", "points", "objects", "feet", "body"):
            if getattr(take, kind):
                data = take.to_xarray(kind)
                data.to_netcdf(part, mode="a" if groups else "w", group=kind, engine="h5netcdf")
                groups.append(kind)
    return len(groups)
