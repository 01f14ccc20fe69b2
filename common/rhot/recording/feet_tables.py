"""The tables beside a depth camera's pictures, each with `t_ns` first.

- `head.csv`: `t_ns,x,y,z,qx,qy,qz,qw`, measured poses of the head, rig frame, metres
- `left.csv`, `right.csv`: `t_ns,ax,ay,az,gx,gy,gz,qx,qy,qz,qw`, specific force m/s², angular rate rad/s, orientation
"""

from __future__ import annotations

import contextlib
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import IO, Annotated, Final

import numpy as np
from pydantic import Field, model_validator

from rhot.arrays import FloatArray, IntArray
from rhot.atomic_file import why, why_unread
from rhot.errors import ConfigError
from rhot.messages import HeadPose, Message, Quaternion, Side
from rhot.messages.base import TimeNs
from rhot.recording.tables import StampGate

# Samples of an ankle's sensor on the bus, from the feet service to who records them.

SENSORS_KEY: Final = "rhot/@sensors"
"""The feet service publishes below this; see `rhot.recording.camera_picture.PICTURES_KEY` for the @."""
MOST_SAMPLES: Final = 1024
"""In one message; a second of a sensor of 1 kHz that was read late."""

_Finite = Annotated[float, Field(ge=-1e6, le=1e6)]
_Vector = tuple[_Finite, _Finite, _Finite]


class SensorSamples(Message):
    """Some samples of one ankle's inertial sensor, as the tracker uses them.

    Attributes:
        t_ns: of the first sample.
        side: which ankle.
        times_ns: of each sample, increasing, rig clock.
        specific_force: m/s², sensor frame; 9.81 upwards at rest.
        angular_rate: rad/s, sensor frame.
        orientation: unit quaternions x, y, z, w, sensor to a level world of the sensor's own with z up.
    """

    side: Side
    times_ns: Annotated[tuple[TimeNs, ...], Field(min_length=1, max_length=MOST_SAMPLES)]
    specific_force: Annotated[tuple[_Vector, ...], Field(max_length=MOST_SAMPLES)]
    angular_rate: Annotated[tuple[_Vector, ...], Field(max_length=MOST_SAMPLES)]
    orientation: Annotated[tuple[Quaternion, ...], Field(max_length=MOST_SAMPLES)]

    @model_validator(mode="after")
    def _together(self) -> SensorSamples:
        counts = {len(self.times_ns), len(self.specific_force), len(self.angular_rate), len(self.orientation)}
        if len(counts) > 1:
            raise ValueError("times_ns, specific_force, angular_rate and orientation differ in length")
        return self


HEAD_FILE: Final = "head.csv"
HEAD_HEADER: Final = ("t_ns", "x", "y", "z", "qx", "qy", "qz", "qw")
SENSOR_HEADER: Final = ("t_ns", "ax", "ay", "az", "gx", "gy", "gz", "qx", "qy", "qz", "qw")
_MOST_WAITING: Final = 4096
"""Batches that wait for the first picture: 20 s of poses and samples."""


def sensor_file(side: str) -> str:
    """Return the name of an ankle sensor's table."""
    return f"{side}.csv"


@dataclass(frozen=True, slots=True)
class _Batch:
    t_ns: Sequence[int]
    values: Sequence[Sequence[float]]
    arrived_ns: int


@dataclass(slots=True)
class _Table:
    header: tuple[str, ...]
    waiting: deque[_Batch] = field(default_factory=lambda: deque(maxlen=_MOST_WAITING))
    gate: StampGate = field(default_factory=StampGate)
    stream: IO[str] | None = None
    t_ns: int = -1
    rows: int = 0
    left_out: int = 0


class FeetTables:
    """Tables that grow beside the pictures of a depth camera; without such a camera nothing is written.

    Use as a context manager.
    """

    def __init__(self, folder: Callable[[], Path | None]) -> None:
        """Prepare.

        Args:
            folder: gives where the depth camera's pictures are, None while there are none.
        """
        self._folder = folder
        self._tables: dict[str, _Table] = {}

    def __enter__(self) -> FeetTables:
        return self

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> None:
        try:
            if kind is None:
                for name, table in self._tables.items():
                    table.gate.settle()
                    self._write(name, table)
        finally:
            for table in self._tables.values():
                if table.stream is not None:
                    # What a full disk keeps in the buffer was told of before.
                    with contextlib.suppress(OSError):
                        table.stream.close()

    @property
    def rows(self) -> dict[str, int]:
        """Rows written, by file."""
        return {name: table.rows for name, table in self._tables.items() if table.rows}

    @property
    def left_out(self) -> int:
        """Poses and samples whose time cannot be."""
        return sum(table.left_out for table in self._tables.values())

    def add_head(self, pose: HeadPose, arrived_ns: int) -> None:
        """Add a pose of the head; a predicted one is of no use to a camera on it.

        Args:
            pose: to add.
            arrived_ns: when it arrived, monotonic.

        Raises:
            ConfigError: the file cannot be written any more.
        """
        if pose.state == "measured":
            self._add(HEAD_FILE, HEAD_HEADER, _Batch([pose.t_ns], [[*pose.position, *pose.orientation]], arrived_ns))

    def add_samples(self, samples: SensorSamples, arrived_ns: int) -> None:
        """Add samples of an ankle's sensor; see `add_head`."""
        columns = zip(samples.specific_force, samples.angular_rate, samples.orientation, strict=True)
        values = [[*force, *rate, *orientation] for force, rate, orientation in columns]
        self._add(sensor_file(samples.side), SENSOR_HEADER, _Batch(samples.times_ns, values, arrived_ns))

    def _add(self, name: str, header: tuple[str, ...], batch: _Batch) -> None:
        table = self._tables.setdefault(name, _Table(header))
        table.waiting.append(batch)
        if not table.gate.ready:
            table.gate.admits(batch.t_ns[-1], batch.arrived_ns)
        self._write(name, table)

    def _write(self, name: str, table: _Table) -> None:
        """Write what waits, once there is a folder and stamps can be judged."""
        folder = self._folder()
        if folder is None or not table.gate.ready:
            return
        try:
            if table.stream is None:
                table.stream = (folder / name).open("w", encoding="utf-8")
                table.stream.write(",".join(table.header) + "\n")
            while table.waiting:
                self._write_batch(table, table.waiting.popleft())
            table.stream.flush()
        except OSError as error:
            raise ConfigError(
                f"{folder / name}: cannot be written any more: {why(error)}; record with --out on another disk"
            ) from error

    def _write_batch(self, table: _Table, batch: _Batch) -> None:
        admitted = table.gate.admits(batch.t_ns[-1], batch.arrived_ns)
        for t_ns, values in zip(batch.t_ns, batch.values, strict=True):
            if not admitted or t_ns <= table.t_ns or table.stream is None:
                table.left_out += 1
                continue
            table.t_ns = t_ns
            table.rows += 1
            table.stream.write(f"{t_ns}," + ",".join(f"{value:.9g}" for value in values) + "\n")


def read_table(file: Path, header: tuple[str, ...]) -> tuple[IntArray, FloatArray]:
    """Return times (N,), ns, strictly increasing, and the other columns (N, len(header) − 1) of a table.

    A last line without its end is left out: the recorder was cut off.

    Raises:
        ConfigError: unreadable, wrong header, not a number, or times that do not increase; names file and line.
    """
    try:
        text = file.read_text(encoding="utf-8-sig")
    except (OSError, UnicodeDecodeError) as error:
        raise ConfigError(f"{file}: cannot be read: {why_unread(error)}") from error
    lines = text[: text.rfind("\n") + 1].splitlines()
    if not lines or tuple(cell.strip() for cell in lines[0].split(",")) != header:
        found = repr(lines[0][:80]) if lines else "an empty file"
        raise ConfigError(f"{file}, line 1: the header must be {','.join(header)}, found {found}")
    times: list[int] = []
    rows: list[list[float]] = []
    for line, (t_ns, values) in _rows(file, lines, len(header)):
        if times and t_ns <= times[-1]:
            raise ConfigError(f"{file}, line {line}: t_ns {t_ns} is not later than {times[-1]} of the row before")
        times.append(t_ns)
        rows.append(values)
    return np.array(times, np.int64), np.array(rows, np.float64).reshape(-1, len(header) - 1)


def _rows(file: Path, lines: Sequence[str], width: int) -> Iterator[tuple[int, tuple[int, list[float]]]]:
    for line, text in enumerate(lines[1:], start=2):
        cells = text.split(",")
        try:
            t_ns, values = int(cells[0]), [float(cell) for cell in cells[1:]]
        except ValueError as error:
            raise ConfigError(f"{file}, line {line}: {text.strip()[:80]!r} is not a row of numbers") from error
        max_ns = 1 << 62
        if len(cells) != width or not 0 <= t_ns < max_ns or not np.isfinite(values).all():
            raise ConfigError(f"{file}, line {line}: {text.strip()[:80]!r}: {width} numbers are needed, all finite")
        yield line, (t_ns, values)
