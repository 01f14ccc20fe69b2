"""TRC (positions of markers) and MOT (joint angles) as OpenSim reads them.

Formats: OpenSim's documentation, "Marker (.trc) Files" and "Motion (.mot) Files". Lengths are metres (`Units m`), time
is rig time from the first pose, angles are degrees. What is absent from a frame is `nan`, as OpenSim itself writes it:
empty cells at the end of a line it refuses.

Legs carry the names and signs of OpenSim's full-body model (Rajagopal et al. 2016, "Full-Body Musculoskeletal Model for
Muscle-Driven Simulation of Human Gait"): with s = r or l,

    hip_flexion_s = hip_flexion,  hip_adduction_s = −hip_abduction,  hip_rotation_s = −hip_rotation (inwards positive),
    knee_angle_s = knee_flexion,  ankle_angle_s = ankle_flexion.

Fingers and wrist carry our own names, `hand_right_index_mcp_flexion`: no model of a hand is standard.
"""

from __future__ import annotations

from typing import Final

import numpy as np

from rhot.arrays import FloatArray
from rhot_tools.export.frames import Frames

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
