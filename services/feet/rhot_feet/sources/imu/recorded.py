"""Inertial samples out of a CSV file: what a BNO080 sends, or specific force and angular rate.

Four headers are understood; of the first three further columns are left alone: `t,qw,qx,qy,qz,lax,lay,laz` (orientation
and linear acceleration), `t,ax,ay,az,gx,gy,gz` (specific force and angular rate; seconds, m/s², rad/s), that of x-io's
loggers with `Gyroscope X (deg/s)` … `Accelerometer Z (g)`, and that of `rhot record --frames`
(`rhot.recording.feet_tables`), which holds the samples as the tracker used them.
"""

from __future__ import annotations

import csv
from collections.abc import Iterable
from pathlib import Path
from typing import Final

import numpy as np

from rhot.arrays import FloatArray
from rhot.atomic_file import why_unread
from rhot.errors import ConfigError
from rhot.recording.feet_tables import SENSOR_HEADER, read_table
from rhot_feet.imu.samples import GRAVITY_M_S2, FusedImuConverter, ImuSamples, RawImuConverter

_FUSED: Final = ("t", "qw", "qx", "qy", "qz", "lax", "lay", "laz")
_RAW: Final = ("t", "ax", "ay", "az", "gx", "gy", "gz")
_XIO: Final = (
    "Time (s)",
    *(f"Accelerometer {axis} (g)" for axis in "XYZ"),
    *(f"Gyroscope {axis} (deg/s)" for axis in "XYZ"),
)
_XIO_UNITS: Final = np.r_[1.0, np.full(3, GRAVITY_M_S2), np.full(3, np.pi / 180.0)]


class RecordedSource:
    """Replays one sensor from the start of the session at the pace of the recording."""

    def __init__(self, path: Path, *, loop: bool = False) -> None:
        """Name the file; it is read by `open`.

        Args:
            path: the CSV file.
            loop: start again at the end.
        """
        self._path = path
        self._loop = loop
        self._start_ns = 0
        self._next = 0
        # Replaced as a whole, so that a converter on another thread sees the old recording or none.
        self._recording: ImuSamples | None = None

    def open(self, start_ns: int) -> None:
        """Read the whole file.

        Raises:
            ConfigError: unreadable or a wrong value; names file and line.
        """
        self._start_ns, self._next, self._recording = start_ns, 0, read_samples(self._path)

    def read(self, now_ns: int) -> ImuSamples:
        """Return the samples up to now that were not returned yet; nothing after the end."""
        recording = self._recording
        if recording is None:
            return ImuSamples.none()
        times = recording.t_ns
        count = len(times)
        # One more spacing from the last sample to the first of the next round.
        length_ns = int(times[-1] - times[0]) * count // (count - 1)
        parts: list[ImuSamples] = []
        while True:
            around, first = divmod(self._next, count)
            base_ns = self._start_ns + around * length_ns - int(times[0])
            last = int(np.searchsorted(times, now_ns - base_ns, side="right"))
            if last <= first or (around and not self._loop):
                return ImuSamples.joined(parts)
            part = recording.rows(first, last)
            parts.append(ImuSamples(part.t_ns + base_ns, part.specific_force, part.angular_rate, part.orientation_xyzw))
            self._next += last - first

    def close(self) -> None:
        """Forget the recording."""
        self._recording = None


def read_samples(path: Path) -> ImuSamples:
    """Read a recording; times count from its own zero.

    Raises:
        ConfigError: unreadable, fewer than two samples, or a wrong value; names file and line.
    """
    try:
        # utf-8-sig: spreadsheets put a byte order mark in front, which would become part of the first column's name.
        with path.open(encoding="utf-8-sig", newline="") as stream:
            rows = csv.reader(stream)
            header = [column.strip() for column in next(rows, [])]
            if tuple(header) == SENSOR_HEADER:
                return _own_samples(path)
            columns = next((names for names in (_FUSED, _RAW, _XIO) if set(names) <= set(header)), None)
            if columns is None:
                raise ConfigError(
                    f"{path}, line 1: the header must hold {','.join(_FUSED)} or {','.join(_RAW)}, got "
                    f"{','.join(header)[:100]!r}"
                )
            indices = [header.index(name) for name in columns]
            table = _table(path, rows, columns, indices)
    except (OSError, UnicodeDecodeError, csv.Error) as error:
        raise ConfigError(f"{path}: cannot be read: {why_unread(error)}") from error
    if len(table) < 2:
        raise ConfigError(f"{path}: holds {len(table)} samples under its header; two are needed")
    t_ns = np.rint(table[:, 0] * 1e9).astype(np.int64)
    if columns is _FUSED:
        return FusedImuConverter().convert(t_ns, table[:, 5:8], table[:, [2, 3, 4, 1]])
    if columns is _XIO:
        table = table * _XIO_UNITS
    return RawImuConverter().convert(t_ns, table[:, 1:4], table[:, 4:7])


def _own_samples(path: Path) -> ImuSamples:
    t_ns, values = read_table(path, SENSOR_HEADER)
    if len(t_ns) < 2:
        raise ConfigError(f"{path}: holds {len(t_ns)} samples under its header; two are needed")
    norms = np.linalg.norm(values[:, 6:], axis=1)
    wrong = np.flatnonzero(np.abs(norms - 1.0) > 1e-3)
    if len(wrong):
        raise ConfigError(f"{path}, line {wrong[0] + 2}: the quaternion {values[wrong[0], 6:]} is no unit quaternion")
    return ImuSamples(t_ns, values[:, :3], values[:, 3:6], values[:, 6:] / norms[:, None])


def _table(path: Path, rows: Iterable[list[str]], columns: tuple[str, ...], indices: list[int]) -> FloatArray:
    table: list[list[float]] = []
    for number, row in enumerate(rows, start=2):
        if not row:
            continue
        where = f"{path}, line {number}"
        values = _values(row, columns, indices, where)
        if table and values == table[-1]:
            # Loggers repeat a sample when no new one has come.
            continue
        if table and values[0] <= table[-1][0]:
            raise ConfigError(
                f"{where}: time {values[0]} s is not after the row before ({table[-1][0]} s); sort the rows"
            )
        if columns is _FUSED and abs(sum(value * value for value in values[1:5]) - 1.0) > 0.1:
            raise ConfigError(f"{where}: the quaternion {values[1:5]} is no unit quaternion")
        table.append(values)
    return np.array(table).reshape(-1, len(columns))


def _values(row: list[str], columns: tuple[str, ...], indices: list[int], where: str) -> list[float]:
    if len(row) <= max(indices):
        raise ConfigError(f"{where}: {len(row)} values, {max(indices) + 1} are needed")
    values = []
    for column, index in zip(columns, indices, strict=True):
        try:
            value = float(row[index])
        except ValueError as error:
            raise ConfigError(f"{where}: {column} {row[index]!r} is not a number") from error
        if not np.isfinite(value) or abs(value) > 1e6:
            raise ConfigError(f"{where}: {column} {row[index]!r} is out of bounds (finite, below 1e6 in size)")
        values.append(value)
    return values
