"""Places in a CSV table."""

from __future__ import annotations

import csv
import math
from pathlib import Path
from typing import Final

import numpy as np

from rhot.atomic_file import why_unread
from rhot.errors import CalibrationError
from rhot.geometry.rotations import rotation_from_quaternion
from rhot_calibration.objects.fit import Places

COLUMNS: Final = (
    *("rig_x_m", "rig_y_m", "rig_z_m"),
    *("tracker_x_m", "tracker_y_m", "tracker_z_m"),
    *("tracker_qx", "tracker_qy", "tracker_qz", "tracker_qw"),
)
SIGMA_COLUMN: Final = "sigma_m"
STATED_SIGMA_M: Final = 1e-3
"""Noise of each coordinate of a place where the table states none; the fit finds the true one from the residuals."""
_LARGEST_M: Final = 100.0
_NORM_TOLERANCE: Final = 0.01


def read_places(file: Path) -> Places:
    """Return the places of a CSV table.

    The header names the columns, in any order: `rig_x_m`, `rig_y_m`, `rig_z_m` (the marker, metres, rig frame),
    `tracker_x_m`, `tracker_y_m`, `tracker_z_m` (the device, metres, tracker space), `tracker_qx`, `tracker_qy`,
    `tracker_qz`, `tracker_qw` (its orientation, unit quaternion), and where it is known `sigma_m` (standard deviation
    of each coordinate). Others are ignored.

    Raises:
        CalibrationError: unreadable, a column is missing, or a value cannot be; names line and column.
    """
    names: list[str] = []
    rows: list[list[float]] = []
    try:
        with file.open(newline="", encoding="utf-8") as stream:
            reader = csv.DictReader(stream)
            header = reader.fieldnames or []
            missing = [name for name in COLUMNS if name not in header]
            if missing:
                raise CalibrationError(f"{file}:1: no column {missing[0]}; the header needs {', '.join(COLUMNS)}")
            wanted = [*COLUMNS, *([SIGMA_COLUMN] if SIGMA_COLUMN in header else [])]
            for row in reader:
                values = [_number(file, reader.line_num, name, row[name]) for name in wanted]
                rows.append([*values, STATED_SIGMA_M][: len(COLUMNS) + 1])
                names.append(f"{file.name}:{reader.line_num}")
                _check(file, reader.line_num, rows[-1])
    except (OSError, UnicodeDecodeError, csv.Error) as error:
        raise CalibrationError(f"{file}: cannot be read: {why_unread(error)}") from error
    table = np.array(rows, dtype=np.float64).reshape(-1, len(COLUMNS) + 1)
    return Places(
        names=tuple(names),
        x_rig=table[:, 0:3],
        sigma_m=table[:, 10],
        R_space_device=rotation_from_quaternion(table[:, 6:10]),
        p_space_device=table[:, 3:6],
    )


def _check(file: Path, line: int, values: list[float]) -> None:
    for name, value in zip(COLUMNS[:6], values[:6], strict=True):
        if abs(value) > _LARGEST_M:
            raise CalibrationError(f"{file}:{line}: {name} is {value:g} m; are the columns in millimetres?")
    norm = math.hypot(*values[6:10])
    if abs(norm - 1.0) > _NORM_TOLERANCE:
        raise CalibrationError(
            f"{file}:{line}: tracker_qx … tracker_qw has norm {norm:.4g}, must be 1; are the columns mixed up?"
        )
    if not 0.0 < values[10] < 1.0:
        raise CalibrationError(f"{file}:{line}: {SIGMA_COLUMN} is {values[10]:g} m; it must lie between 0 and 1")


def _number(file: Path, line: int, name: str, text: str | None) -> float:
    try:
        value = float(text or "")
    except ValueError as error:
        raise CalibrationError(f"{file}:{line}: {name} is '{(text or '')[:40]}', not a number") from error
    if not math.isfinite(value):
        raise CalibrationError(f"{file}:{line}: {name} is {value}; it must be finite")
    return value
