"""A tracked object from a CSV file: `t_ns,x,y,z,qx,qy,qz,qw`, metres, tracker space."""

from __future__ import annotations

import csv
from collections.abc import Mapping
from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import NDArray

from rhot.atomic_file import why_unread
from rhot.errors import ConfigError
from rhot_objects.pose import Pose, interpolate
from rhot_objects.sources import PoseSample

COLUMNS: Final = ("t_ns", "x", "y", "z", "qx", "qy", "qz", "qw")


class RecordedSource:
    """Replays one object from the start of the session at the original rate.

    Poses between two rows are interpolated (linearly and by slerp), whatever their distance in time. After the last row
    the object is not tracked, unless the recording loops.
    """

    def __init__(self, object_id: str, path: Path, *, loop: bool = False) -> None:
        """Set the file, which `open` reads.

        Args:
            object_id: id of the object.
            path: the CSV file.
            loop: whether to restart at the end.
        """
        self._object_id = object_id
        self._path = path
        self._loop = loop
        self._start_ns = 0
        # Replaced as a whole, so that another thread sees either the old recording or none.
        self._recording: tuple[NDArray[np.int64], list[Pose]] | None = None

    def open(self, start_ns: int) -> None:
        """Read the whole file.

        Raises:
            ConfigError: the file cannot be read, or has a wrong value; names file and line.
        """
        recording = read_poses(self._path)
        if len(recording[1]) == 1 and not self._loop:
            raise ConfigError(
                f"{self._path}: holds a single pose, which is over as soon as it begins; add rows, or hold it for ever "
                f"with `loop = true` in [objects.{self._object_id}]"
            )
        self._start_ns, self._recording = start_ns, recording

    def read(self, now_ns: int) -> Mapping[str, PoseSample]:
        """Return the pose at this time; nothing before the start and after the end."""
        recording, elapsed_ns = self._recording, now_ns - self._start_ns
        if recording is None or elapsed_ns < 0:
            return {}
        times_ns, poses = recording
        length_ns = int(times_ns[-1] - times_ns[0])
        if self._loop:
            elapsed_ns = elapsed_ns % length_ns if length_ns else 0
        if elapsed_ns > length_ns:
            return {}
        return {self._object_id: PoseSample(now_ns, _pose_at(int(times_ns[0]) + elapsed_ns, times_ns, poses))}

    def close(self) -> None:
        """Release the recording."""
        self._recording = None


def _pose_at(t_ns: int, times_ns: NDArray[np.int64], poses: list[Pose]) -> Pose:
    """Return the pose at a time between the first and the last row."""
    after = int(np.searchsorted(times_ns, t_ns, side="right"))
    if after == len(poses):
        return poses[-1]
    before_ns, after_ns = int(times_ns[after - 1]), int(times_ns[after])
    return interpolate(poses[after - 1], poses[after], (t_ns - before_ns) / (after_ns - before_ns))


def read_poses(path: Path) -> tuple[NDArray[np.int64], list[Pose]]:
    """Read a recording of one object.

    Returns:
        Times (N,), nanoseconds, strictly increasing, and the N poses T_space_device with unit quaternions.

    Raises:
        ConfigError: unreadable, no rows, or a wrong value; names file and line.
    """
    times: list[int] = []
    poses: list[Pose] = []
    try:
        # utf-8-sig: spreadsheets put a byte order mark in front, which would become part of the first column's name.
        with path.open(encoding="utf-8-sig", newline="") as stream:
            rows = csv.reader(stream)
            header = next(rows, [])
            if tuple(column.strip() for column in header) != COLUMNS:
                raise ConfigError(f"{path}, line 1: the header must be {','.join(COLUMNS)}, got {','.join(header)!r}")
            for row in rows:
                if not row:
                    continue
                where = f"{path}, line {rows.line_num}"
                t_ns, pose = _parse(row, where)
                if times and t_ns <= times[-1]:
                    raise ConfigError(f"{where}: t_ns {t_ns} is not after the row before ({times[-1]}); sort the rows")
                times.append(t_ns)
                poses.append(pose)
    except (OSError, UnicodeDecodeError, csv.Error) as error:
        raise ConfigError(f"{path}: cannot be read: {why_unread(error)}") from error
    if not poses:
        raise ConfigError(f"{path}: holds no rows under its header")
    return np.array(times, dtype=np.int64), poses


def _parse(row: list[str], where: str) -> tuple[int, Pose]:
    if len(row) != len(COLUMNS):
        raise ConfigError(f"{where}: {len(row)} values instead of {len(COLUMNS)} ({','.join(COLUMNS)})")
    try:
        t_ns = int(row[0])
    except ValueError as error:
        raise ConfigError(f"{where}: t_ns {row[0]!r} is not a whole number of nanoseconds") from error
    if not 0 <= t_ns < 1 << 63:
        raise ConfigError(f"{where}: t_ns {t_ns} is not between 0 and 2^63 nanoseconds")
    values = []
    for column, text in zip(COLUMNS[1:], row[1:], strict=True):
        try:
            value = float(text)
        except ValueError as error:
            raise ConfigError(f"{where}: {column} {text!r} is not a number") from error
        if not np.isfinite(value) or abs(value) > 1e6:
            raise ConfigError(f"{where}: {column} {text!r} is out of bounds (finite, below 1e6 in size)")
        values.append(value)
    try:
        return t_ns, Pose.from_arrays(values[:3], values[3:])
    except ValueError as error:
        raise ConfigError(f"{where}: the quaternion {row[4:]} has no length, so it is no rotation") from error
