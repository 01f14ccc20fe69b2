"""Everything that moves, read at common moments: files of biomechanics hold frames at one steady rate.

Time 0 is the first pose of any of them. Positions between two poses lie on the straight line between them, as far apart
as `MAX_GAP_S`; where there is none, the frame holds nothing (NaN).
"""

from __future__ import annotations

import tempfile
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from rhot.arrays import FloatArray
from rhot.atomic_file import replacing
from rhot.messages import Event
from rhot.plugins import load_library
from rhot_tools.export.poses import ExportedMotion, frame_times_s

# C3D (biomechanics, c3d.org), for Mokka, Visual3D, MATLAB and others: markers in millimetres at a steady rate.
#
# A marker that is absent from a frame has the residual −1, which C3D programs show as a gap. Frames are numbered with
# 16 bits: of longer takes every reader tried shows the first 65,535 frames and no more, so they go into several
# files.

MM_PER_M: Final = 1e3
"""C3D programs expect millimetres, whatever POINT:UNITS says."""


MOST_FRAMES: Final = 65_000
"""Of one file."""


def write_c3d(file: Path, frames: Frames, *, y_up: bool) -> list[Path]:
    """Write markers, and return the files: of longer takes `grasp-001.c3d` and so on, each from its own time 0.

    Args:
        file: to write.
        frames: the markers.
        y_up: whether the vertical is known to be y; told to programs that draw the scene.

    Raises:
        ConfigError: ezc3d is not installed, or the file cannot be written.
    """
    ezc3d = load_library("ezc3d", "--c3d", "c3d")
    starts = range(0, len(frames.t_s), MOST_FRAMES)
    files = [file] if len(starts) == 1 else [file.with_stem(f"{file.stem}-{k:03d}") for k in range(1, len(starts) + 1)]
    for part, start in zip(files, starts, strict=True):
        made = _made(ezc3d, frames, frames.positions[start : start + MOST_FRAMES], y_up)
        _add_events(made, frames, start / frames.rate_hz, MOST_FRAMES / frames.rate_hz)
        _write(made, part)
    return files


def _made(ezc3d: Any, frames: Frames, metres: FloatArray, y_up: bool) -> Any:
    """Return a file of positions (F, M, 3), metres."""
    positions = MM_PER_M * np.moveaxis(metres, 0, -1)
    absent: NDArray[np.bool_] = np.asarray(np.isnan(positions).any(axis=1))
    positions = np.where(absent[:, None], 0.0, positions)
    made = ezc3d.c3d()
    point = made["parameters"]["POINT"]
    point["UNITS"]["value"] = ["mm"]
    point["RATE"]["value"] = [frames.rate_hz]
    point["LABELS"]["value"] = list(frames.markers)
    point["DESCRIPTIONS"]["value"] = list(frames.markers)
    if y_up:
        made.add_parameter("POINT", "X_SCREEN", ["+X"])
        made.add_parameter("POINT", "Y_SCREEN", ["+Y"])
    ones = np.ones((1, *positions.shape[::2]))
    made["data"]["points"] = np.concatenate([positions.transpose(1, 0, 2), ones])
    made["data"]["meta_points"]["residuals"] = np.where(absent, -1.0, 0.0)[None]
    made["data"]["meta_points"]["camera_masks"] = np.zeros((7, *absent.shape), dtype=bool)
    return made


def _add_events(made: Any, frames: Frames, begin_s: float, length_s: float) -> None:
    """Add the marked moments of a part as C3D's group EVENT: minutes and seconds from the part's first frame."""
    found = [(t_s - begin_s, label) for t_s, label in frames.events if 0.0 <= t_s - begin_s < length_s]
    if found:
        made.add_parameter("EVENT", "USED", [len(found)])
        made.add_parameter("EVENT", "CONTEXTS", ["General"] * len(found))
        made.add_parameter("EVENT", "LABELS", [label for _, label in found])
        made.add_parameter("EVENT", "DESCRIPTIONS", [""] * len(found))
        minutes = [float(t_s // 60.0) for t_s, _ in found]
        made.add_parameter("EVENT", "TIMES", np.array([minutes, [t_s % 60.0 for t_s, _ in found]]))


def _write(made: Any, file: Path) -> None:
    with replacing(file) as part, tempfile.TemporaryDirectory(dir=file.parent, prefix=".rhot-c3d-") as folder:
        # ezc3d appends the suffix to any other name.
        whole = Path(folder) / "whole.c3d"
        made.write(str(whole))
        part.write_bytes(whole.read_bytes())


# TRC (positions of markers) and MOT (joint angles) as OpenSim reads them.
#
# Formats: OpenSim's documentation, "Marker (.trc) Files" and "Motion (.mot) Files". Lengths are metres (`Units m`),
# time is rig time from the first pose, angles are degrees. What is absent from a frame is `nan`, as OpenSim itself
# writes it: empty cells at the end of a line it refuses.
#
# Legs carry the names and signs of OpenSim's full-body model (Rajagopal et al. 2016, "Full-Body Musculoskeletal Model
# for Muscle-Driven Simulation of Human Gait"): with s = r or l,
#
#     hip_flexion_s = hip_flexion, hip_adduction_s = −hip_abduction, hip_rotation_s = −hip_rotation (inwards),
#     knee_angle_s = knee_flexion,  ankle_angle_s = ankle_flexion.
#
# Fingers and wrist carry our own names, `hand_right_index_mcp_flexion`: no model of a hand is standard.

_LEG_ANGLES: Final = {
    "hip_flexion": ("hip_flexion", 1.0),
    "hip_abduction": ("hip_adduction", -1.0),
    "hip_rotation": ("hip_rotation", -1.0),
    "knee_flexion": ("knee_angle", 1.0),
    "ankle_flexion": ("ankle_angle", 1.0),
}
"""Our angle to OpenSim's coordinate and its sign."""


def trc_text(frames: Frames, name: str) -> str:
    """Return the TRC file of the markers; `name` is that of the file."""
    count, markers = len(frames.t_s), len(frames.markers)
    rate = f"{frames.rate_hz:.6f}"
    lines = [
        f"PathFileType\t4\t(X/Y/Z)\t{name}",
        "DataRate\tCameraRate\tNumFrames\tNumMarkers\tUnits\tOrigDataRate\tOrigDataStartFrame\tOrigNumFrames",
        f"{rate}\t{rate}\t{count}\t{markers}\tm\t{rate}\t1\t{count}",
        "Frame#\tTime\t" + "\t\t\t".join(frames.markers) + "\t\t",
        "\t\t" + "\t".join(f"{axis}{number}" for number in range(1, markers + 1) for axis in "XYZ"),
        "",
    ]
    for number, (t_s, row) in enumerate(zip(frames.t_s, frames.positions.reshape(count, -1), strict=True), start=1):
        cells = (f"{value:.6f}" for value in row.tolist())
        lines.append(f"{number}\t{t_s:.6f}\t" + "\t".join(cells))
    return "\n".join(lines) + "\n"


def mot_text(frames: Frames, name: str) -> str:
    """Return the MOT file of the joint angles; `name` is that of the motion."""
    columns = coordinates_deg(frames)
    lines = [
        name,
        "version=1",
        f"nRows={len(frames.t_s)}",
        f"nColumns={1 + len(columns)}",
        "inDegrees=yes",
        "",
        "Units are S.I. units (second, meters, Newtons, ...)",
        "Angles are in degrees.",
        "",
        "endheader",
        "\t".join(["time", *columns]),
    ]
    rows = np.column_stack(list(columns.values())) if columns else np.empty((len(frames.t_s), 0))
    for t_s, row in zip(frames.t_s.tolist(), rows.tolist(), strict=True):
        lines.append("\t".join([f"{t_s:.6f}", *(f"{value:.6f}" for value in row)]))
    return "\n".join(lines) + "\n"


def coordinates_deg(frames: Frames) -> dict[str, FloatArray]:
    """Return the columns of a MOT file, (F,) degrees, by OpenSim's names where it has one."""
    columns: dict[str, FloatArray] = {}
    for name, values in frames.angles.items():
        part, _, angle = name.partition("_")
        side, _, angle = angle.partition("_")
        if part == "body" and angle in _LEG_ANGLES:
            coordinate, sign = _LEG_ANGLES[angle]
            columns[f"{coordinate}_{side[0]}"] = sign * np.degrees(values)
        else:
            columns[name] = np.degrees(values)
    return columns


MAX_GAP_S: Final = 0.1
"""Longest pause between two poses that is bridged: a hand that turns back with 10 m/s² leaves the straight line by
a·t²/8 = 12 mm in it."""
AXIS_M: Final = 0.1
"""Length of a rigid thing's axes, whose ends are markers beside its origin: its rotation follows from them."""
_ROUND: Final = 24
"""Poses of a round: a multiple of 2, 3, 4, 6 and 8 cameras."""
_ALIKE: Final = 0.02
_STEADY: Final = 0.6
"""Intervals come steadily where so great a share of them is that near to the median, as a part of it. Of two cameras
out of step it is half; of one that loses every fourth frame, two thirds."""
_AXES: Final = ("x", "y", "z")


@dataclass(frozen=True, slots=True)
class Frames:
    """Markers and angles at a steady rate.

    Attributes:
        rate_hz: frames per second.
        t_s: (F,) times, seconds, from 0.
        markers: (M,) names.
        positions: (F, M, 3) metres; NaN where there is none.
        angles: by name, (F,) radians; NaN where there is none.
        events: seconds and label of marked moments.
    """

    rate_hz: float
    t_s: FloatArray
    markers: tuple[str, ...]
    positions: FloatArray
    angles: Mapping[str, FloatArray]
    events: Sequence[tuple[float, str]] = ()


def frames_of(motions: Sequence[ExportedMotion], rate_hz: float | None = None, events: Sequence[Event] = ()) -> Frames:
    """Read motions at common moments.

    Args:
        motions: at least one.
        rate_hz: frames per second; None = the real rate of the fastest motion, see `real_rate_hz`.
        events: marked moments.

    Raises:
        ConfigError: see `frame_times_s`.
    """
    origin_ns = min(int(motion.t_ns[0]) for motion in motions)
    end_s = max(int(motion.t_ns[-1]) - origin_ns for motion in motions) / 1e9
    rate = rate_hz if rate_hz is not None else max(real_rate_hz(motion.t_ns) for motion in motions)
    t_s = frame_times_s(end_s, rate)
    names: list[str] = []
    columns: list[FloatArray] = []
    angles: dict[str, FloatArray] = {}
    for motion in motions:
        at_s = (motion.t_ns - origin_ns) / 1e9
        marked, positions = _markers(motion)
        names += marked
        columns.append(_read(at_s, positions.reshape(len(at_s), -1), t_s).reshape(len(t_s), -1, 3))
        angled = {**motion.angles, **(wrist_angles(motion) if motion.is_hand else {})}
        angles |= {f"{motion.name}_{name}": _read(at_s, v[:, None], t_s)[:, 0] for name, v in angled.items()}
    marked_s = [((event.t_ns - origin_ns) / 1e9, event.label) for event in events]
    return Frames(rate, t_s, tuple(names), np.concatenate(columns, axis=1), angles, marked_s)


def wrist_angles(motion: ExportedMotion) -> dict[str, FloatArray]:
    """Return yaw, pitch and roll (N,), radians, of a hand's wrist against the axes of the motion's frame.

    R = Ry(yaw)·Rx(pitch)·Rz(roll) with OpenXR's axes of the wrist (−z along the fingers, +y out of the back of the
    hand). In the stage: yaw to the left, fingers up and, seen by the person, counter-clockwise are positive. They are
    not flexion and deviation: those are against the forearm, which no marker shows. Yaw and roll go on over ±180°.
    """
    R = motion.rotations[:, motion.root]
    return {
        "wrist_yaw": np.unwrap(np.arctan2(R[:, 0, 2], R[:, 2, 2])),
        "wrist_pitch": np.arcsin(np.clip(-R[:, 1, 2], -1.0, 1.0)),
        "wrist_roll": np.unwrap(np.arctan2(R[:, 1, 0], R[:, 1, 1])),
    }


def real_rate_hz(t_ns: NDArray[np.int64]) -> float:
    """Return how many poses come in a second, of times (N,); 60 where there is one time alone.

    It is the inverse of the median interval, so that lost frames and pauses do not count. A hand is seen by cameras in
    turn, with long and short intervals between them: there it is the median over rounds of all cameras.
    """
    intervals = np.diff(t_ns)
    if not len(intervals):
        return 60.0
    usual = float(np.median(intervals))
    alike = np.abs(intervals - usual) <= _ALIKE * usual
    if alike.mean() < _STEADY and len(t_ns) > 2 * _ROUND:
        usual = float(np.median(t_ns[_ROUND:] - t_ns[:-_ROUND])) / _ROUND
    return 1e9 / usual


def _markers(motion: ExportedMotion) -> tuple[list[str], FloatArray]:
    """Return the names and positions (N, M, 3) of a motion's joints, or of a rigid thing's origin and axes."""
    if not motion.is_rigid:
        return [f"{motion.name}_{joint}" for joint in motion.joints], motion.positions
    origin, R = motion.positions[:, :1], motion.rotations[:, 0]
    ends = origin + AXIS_M * np.swapaxes(R, -1, -2)
    return [motion.name, *(f"{motion.name}_{axis}" for axis in _AXES)], np.concatenate([origin, ends], axis=1)


def _read(at_s: FloatArray, values: FloatArray, t_s: FloatArray) -> FloatArray:
    """Return values (N, C) of times (N,) at times (F,); NaN before the first, after the last and in longer gaps."""
    before = np.clip(np.searchsorted(at_s, t_s, side="right") - 1, 0, max(len(at_s) - 2, 0))
    after = np.minimum(before + 1, len(at_s) - 1)
    span_s = at_s[after] - at_s[before]
    share = (t_s - at_s[before]) / np.maximum(span_s, 1e-9)
    # Half a microsecond of rounding is no gap.
    share = np.where(np.abs(t_s - at_s[before]) < 5e-7, 0.0, np.where(np.abs(t_s - at_s[after]) < 5e-7, 1.0, share))
    read: FloatArray = values[before] + share[:, None] * (values[after] - values[before])
    exact = (share == 0.0) | (share == 1.0)
    read[(share < 0.0) | (share > 1.0) | ((span_s > MAX_GAP_S) & ~exact)] = np.nan
    return read
