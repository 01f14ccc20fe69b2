"""The two tables of a recording, `frame,t_ns` and `frame,t_ns,marker,u,v`; errors name file and line."""

from __future__ import annotations

import math
import re
import statistics
from collections.abc import Iterator
from pathlib import Path
from typing import Final, NoReturn

import numpy as np

from rhot.arrays import IntArray
from rhot.atomic_file import why_unread
from rhot.errors import ConfigError
from rhot.recording.model import MarkerTrack, TrackTiming, frozen_array
from rhot.text import read_text

# Telling stamps that cannot be true from those that can, without a clock in common with whoever made them.
#
# The offset of a picture is its stamp less its arrival. A picture may come late by any time, which makes the offset
# smaller, but never before it was taken: the largest offset that was confirmed is the clocks' difference, and one that
# exceeds it by more than the tolerance claims a time that has not come yet.

TOLERANCE_NS: Final = 2_000_000_000
"""By how much the network's shortest delay may vary while a recording begins; chosen: longer than any stall of a link
that still works (1 s of WiFi roaming), shorter than anything that would matter to who reads the recording."""
CONFIRMATIONS: Final = 3
"""Stamps in a row that agree with one another make a new time: the rig clock was set. A single wrong one does not."""


class StampGate:
    """Judges the stamps of one source in the order of their arrival."""

    def __init__(self) -> None:
        self._reference_ns: int | None = None
        self._contradicting: list[int] = []

    @property
    def ready(self) -> bool:
        """Whether enough stamps are known to judge by."""
        return self._reference_ns is not None

    def settle(self) -> None:
        """Judge from now on by the few stamps that have come: nothing that contradicts the earliest is admitted."""
        if self._reference_ns is None and self._contradicting:
            self._reference_ns = statistics.median_low(self._contradicting)

    def admits(self, t_ns: int, arrived_ns: int) -> bool:
        """Return whether a stamp can be true.

        Until `CONFIRMATIONS` stamps are known, all are refused: show them again when `ready`.

        Args:
            t_ns: the stamp, on the source's clock.
            arrived_ns: its arrival, on any clock that neither stops nor is set.
        """
        offset_ns = t_ns - arrived_ns
        if self._reference_ns is not None and offset_ns <= self._reference_ns + TOLERANCE_NS:
            self._reference_ns = max(self._reference_ns, offset_ns)
            self._contradicting.clear()
            return True
        self._contradicting.append(offset_ns)
        if len(self._contradicting) < CONFIRMATIONS:
            return False
        middle_ns = statistics.median_low(self._contradicting)
        agree = all(abs(each - middle_ns) <= TOLERANCE_NS for each in self._contradicting)
        if self._reference_ns is None or agree:
            self._reference_ns = middle_ns
            self._contradicting.clear()
            return offset_ns <= middle_ns + TOLERANCE_NS
        del self._contradicting[0]
        return False


TIMES_HEADER = ("frame", "t_ns")
MARKERS_HEADER = ("frame", "t_ns", "marker", "u", "v")

_MARKER_NAME = re.compile(r"[A-Za-z0-9_.-]{1,64}")
_MAX_PIXEL = 1e5


def read_times(file: Path, *, complete: bool = True) -> tuple[IntArray, IntArray]:
    """Return frame numbers (N,) and times (N,), ns, of a `frame,t_ns` table, both strictly increasing.

    Where the recorder was cut off (not `complete`), a last line without an end is left out.

    Raises:
        ConfigError: unreadable, wrong header, not a number, or going backwards; names file and line.
    """
    frames: list[int] = []
    times: list[int] = []
    for line, (frame_text, time_text) in _rows(file, TIMES_HEADER, complete=complete):
        frame, t_ns = _integer(file, line, "frame", frame_text), _integer(file, line, "t_ns", time_text)
        if frames and frame <= frames[-1]:
            _fail(file, line, f"frame {frame} follows frame {frames[-1]}; frame numbers must increase")
        if times and t_ns <= times[-1]:
            _fail(file, line, f"t_ns {t_ns} is not later than {times[-1]} of the row before; times must increase")
        frames.append(frame)
        times.append(t_ns)
    if not frames:
        raise ConfigError(f"{file}: holds a header and no rows; write one row a frame")
    return frozen_array(frames), frozen_array(times)


def read_marker_track(file: Path, name: str, timing: TrackTiming) -> MarkerTrack:
    """Return a camera's marker track.

    Frame numbers must not decrease, each frame has one time, later than the frame before, and a marker occurs at
    most once in a frame.

    Raises:
        ConfigError: unreadable, wrong header, not a number, going backwards or doubled; names file and line.
    """
    index_of: dict[str, int] = {}
    frames: list[int] = []
    times: list[int] = []
    marker: list[int] = []
    uv: list[tuple[float, float]] = []
    seen: set[int] = set()
    last_frame, last_time = -1, -1
    for line, (frame_text, time_text, marker_name, u_text, v_text) in _rows(file, MARKERS_HEADER):
        frame, t_ns = _integer(file, line, "frame", frame_text), _integer(file, line, "t_ns", time_text)
        if frame != last_frame:
            if frame < last_frame:
                _fail(file, line, f"frame {frame} follows frame {last_frame}; frame numbers must not decrease")
            if t_ns <= last_time:
                _fail(file, line, f"t_ns {t_ns} is not later than {last_time} of the frame before; times must increase")
            last_frame, last_time = frame, t_ns
            seen.clear()
        elif t_ns != last_time:
            _fail(file, line, f"t_ns {t_ns} differs from {last_time} in the same frame {frame}; a frame has one time")
        if marker_name not in index_of:
            if not _MARKER_NAME.fullmatch(marker_name):
                _fail(file, line, f"marker = {marker_name!r} is not a marker name (letters, digits, _ . -)")
            index_of[marker_name] = len(index_of)
        index = index_of[marker_name]
        if index in seen:
            _fail(file, line, f"marker {marker_name} occurs twice in frame {frame}")
        seen.add(index)
        frames.append(frame)
        times.append(t_ns)
        marker.append(index)
        uv.append((_pixel(file, line, "u", u_text), _pixel(file, line, "v", v_text)))
    if not frames:
        raise ConfigError(f"{file}: holds a header and no rows; a marker that is seen has one row a frame")
    pixels = np.array(uv, dtype=np.float64)
    pixels.setflags(write=False)
    return MarkerTrack(
        name, file, tuple(index_of), frozen_array(frames), frozen_array(times), frozen_array(marker), pixels, timing
    )


def _rows(file: Path, header: tuple[str, ...], *, complete: bool = True) -> Iterator[tuple[int, list[str]]]:
    try:
        text = read_text(file)
    except (OSError, UnicodeDecodeError) as error:
        raise ConfigError(f"{file}: cannot be read: {why_unread(error)}") from error
    lines = (text if complete else text[: text.rfind("\n") + 1]).splitlines()
    expected = ",".join(header)
    if not lines or tuple(cell.strip() for cell in lines[0].split(",")) != header:
        found = repr(lines[0][:80]) if lines else "an empty file"
        raise ConfigError(f"{file}, line 1: the header must be {expected}, found {found}")
    width = len(header)
    for line, text in enumerate(lines[1:], start=2):
        cells = text.split(",")
        if len(cells) == width:
            yield line, cells
        elif text.strip():
            _fail(file, line, f"{len(cells)} values, the header {expected} asks for {width}")


def _integer(file: Path, line: int, field: str, text: str) -> int:
    try:
        value = int(text)
    except ValueError:
        _fail(file, line, f"{field} = {text.strip()[:40]!r} is not an integer")
    max_integer = (1 << 63) - 1
    if not 0 <= value <= max_integer:
        _fail(file, line, f"{field} = {value} is out of range, must be 0 to 2^63 − 1")
    return value


def _pixel(file: Path, line: int, field: str, text: str) -> float:
    try:
        value = float(text)
    except ValueError:
        _fail(file, line, f"{field} = {text.strip()[:40]!r} is not a number")
    if not math.isfinite(value) or abs(value) > _MAX_PIXEL:
        _fail(file, line, f"{field} = {text.strip()[:40]} is not a pixel coordinate (finite, at most {_MAX_PIXEL:g})")
    return value


def _fail(file: Path, line: int, what: str) -> NoReturn:
    raise ConfigError(f"{file}, line {line}: {what}")
