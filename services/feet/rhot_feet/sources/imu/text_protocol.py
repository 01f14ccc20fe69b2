"""The text protocol of a BNO080 on a serial line; see docs/feet.md.

A line is `timestamp L x y z;` (linear acceleration, m/s², sensor frame) or `timestamp R i j k real;` (rotation vector
as a quaternion, sensor to a level world). The line has no checksum: what is not a whole line is dropped, and values
that no sensor can send are. The timestamp counts milliseconds or microseconds; which, the spacing of the lines tells.
"""

from __future__ import annotations

import math
import re
from collections import deque
from typing import Final

import numpy as np

from rhot_feet.imu.conversion import LONGEST_STEP_S, FusedImuConverter
from rhot_feet.imu.samples import ImuSamples
from rhot_feet.sources.imu.device_clock import DeviceClock

_LINE: Final = re.compile(
    rb"(\d{1,10})[\s,]+([LR])[\s,:]+(-?\d+(?:\.\d*)?(?:[eE]-?\d+)?(?:[\s,]+-?\d+(?:\.\d*)?(?:[eE]-?\d+)?){2,3})[\s,]*"
)
_LONGEST_LINE: Final = 200
"""Bytes without a semicolon: noise, or another baud rate."""
_MOST_ACCELERATION: Final = 160.0
"""m/s² per axis: 16 g, the end of the sensor's scale."""
_UNIT_BAND: Final = 0.05
_TICKS_NS: Final = (1_000_000, 1_000)
_STAMPS: Final = 12
"""Lines of one kind that show the timestamp's unit."""
_ROTATIONS: Final = 16
"""Rotations kept for accelerations that arrive after them: more than the 0.1 s that stamps of two kinds may differ."""

_Values = tuple[float, ...]


class TextDecoder:
    """Bytes of the text protocol to samples; keeps what is incomplete for the next call."""

    def __init__(self, rate_hz: float) -> None:
        """Set the expected rate, which tells milliseconds from microseconds."""
        self._rate_hz = rate_hz
        self._rest = b""
        self._clock: DeviceClock | None = None
        self._spacing: list[int] = []
        self._accelerations: deque[tuple[int, _Values]] = deque()
        self._rotations: deque[tuple[int, _Values]] = deque(maxlen=_ROTATIONS)
        self._converter = FusedImuConverter()
        self._last_ns = 0
        self._damaged = 0

    @property
    def faults(self) -> int:
        """Lines so far that were damaged, or whose stamp cannot be."""
        return self._damaged + (0 if self._clock is None else self._clock.refused)

    def decode(self, data: bytes, arrival_ns: int) -> ImuSamples:
        """Return the samples that are complete now.

        Args:
            data: as read from the line.
            arrival_ns: rig time of the reading.
        """
        *pieces, self._rest = (self._rest + data).split(b";")
        if len(self._rest) > _LONGEST_LINE:
            self._rest = b""
            self._damaged += 1
        parts = [part for piece in pieces for part in self._line(piece, arrival_ns)]
        return ImuSamples.joined(parts)

    def _line(self, piece: bytes, arrival_ns: int) -> list[ImuSamples]:
        # After a lost semicolon two lines hang together; the last one is whole.
        match = _LINE.fullmatch(piece.strip().rsplit(b"\n", 1)[-1].strip())
        stamp = int(match[1]) if match else 1 << 32
        if match is None or stamp >= 1 << 32:
            self._damaged += bool(piece.strip())
            return []
        values = tuple(float(text) for text in re.split(rb"[\s,]+", match[3]))
        kind = match[2]
        if not _plausible(kind, values):
            self._damaged += 1
            return []
        t_ns = self._rig_ns(kind, stamp, arrival_ns)
        if t_ns is None:
            return []
        (self._accelerations if kind == b"L" else self._rotations).append((t_ns, values))
        return self._paired()

    def _rig_ns(self, kind: bytes, stamp: int, arrival_ns: int) -> int | None:
        if self._clock is None:
            if kind == b"R":
                self._spacing.append(stamp)
            if len(self._spacing) < _STAMPS:
                return None
            spacing = float(np.median(np.diff(self._spacing)))
            self._spacing.clear()
            if spacing <= 0.0:
                return None
            tick_ns = min(_TICKS_NS, key=lambda tick: abs(math.log(spacing * tick * 1e-9 * self._rate_hz)))
            self._clock = DeviceClock(tick_ns)
        return self._clock.to_rig_ns(stamp, arrival_ns, kind)

    def _paired(self) -> list[ImuSamples]:
        """Return the accelerations that lie between two rotations by now, each with the rotation of its moment."""
        parts: list[ImuSamples] = []
        while self._accelerations and self._rotations and self._accelerations[0][0] <= self._rotations[-1][0]:
            t_ns, acceleration = self._accelerations.popleft()
            after = next(index for index, (t1, _) in enumerate(self._rotations) if t1 >= t_ns)
            t1, q1 = self._rotations[after]
            t0, q0 = self._rotations[after - 1] if after and t1 > t_ns else (t1, q1)
            if t_ns < t0 or t1 - t0 > LONGEST_STEP_S * 1e9 or t_ns <= self._last_ns:
                continue
            share = (t_ns - t0) / (t1 - t0) if t1 > t0 else 1.0
            a, b = np.array(q0), np.array(q1)
            # A hundredth of a second apart, the straight line between quaternions is as good as the arc.
            q = (1.0 - share) * a + share * (b if a @ b >= 0.0 else -b)
            self._last_ns = t_ns
            parts.append(self._converter.convert(np.array([t_ns]), np.array([acceleration]), q[None]))
        return parts


def _plausible(kind: bytes, values: _Values) -> bool:
    if kind == b"L":
        return len(values) == 3 and max(abs(value) for value in values) <= _MOST_ACCELERATION
    return len(values) == 4 and abs(math.sqrt(sum(value * value for value in values)) - 1.0) <= _UNIT_BAND


def encode_text(stamp: int, acceleration: _Values, quaternion_xyzw: _Values) -> bytes:
    """Return the two lines of one sample, as the sensor sends them."""
    a = " ".join(f"{value:.3f}" for value in acceleration)
    q = " ".join(f"{value:.5f}" for value in quaternion_xyzw)
    return f"{stamp} L {a};\n{stamp} R {q};\n".encode()
