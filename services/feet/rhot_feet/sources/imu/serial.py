"""A sensor on a serial port, by the `serial` package (pyserial)."""

from __future__ import annotations

import binascii
import importlib
import logging
import math
import re
import struct
from collections import deque
from collections.abc import Sequence
from typing import Any, Final, Protocol

import numpy as np

from rhot.arrays import FloatArray
from rhot.errors import DeviceError
from rhot.rig.feet_config import ImuConfig
from rhot_feet.imu.samples import LONGEST_STEP_S, FusedImuConverter, ImuSamples, RawImuConverter

# The clock of a sensor on a wire, mapped to the rig clock.
#
# A sensor stamps its samples with a 32-bit counter that wraps around, and they arrive some time later. A delay is never
# negative, so the smallest offset arrival − stamp is closest to the true one; it is kept, and rises slowly to allow for
# the drift between two oscillators:
#
#     offset ← min(offset + drift · elapsed, arrival − stamp).
#
# The shortest delay itself (a millisecond or so on a serial line) stays in the offset.
#
# A sensor may send several kinds of report, each with the stamp of its own measurement. Within one kind stamps only
# rise; between kinds they may step back a little.

_WRAP: Final = 1 << 32
_DRIFT: Final = 100e-6
"""Largest relative drift between two oscillators."""
_LONGEST_NS: Final = 1_000_000_000
"""A stamp that jumps by more, or backwards, is suspect. A sample that arrives this much earlier or later than expected
means that the rig clock was set, because no serial line delays samples by a second."""


class DeviceClock:
    """Unwraps the counter of one sensor and maps it to rig time; reads no clock itself."""

    def __init__(self, tick_ns: int) -> None:
        """Set the counter's unit, nanoseconds."""
        self._tick_ns = tick_ns
        self._stamp: int | None = None
        self._start_ns = 0
        self._device_ns = 0
        self._offset_ns = 0.0
        self._doubted: dict[bytes, list[int]] = {}
        self._last: dict[bytes, tuple[int, int]] = {}
        self.refused = 0

    def to_rig_ns(self, stamp: int, arrival_ns: int, kind: bytes = b"") -> int | None:
        """Return the rig time of a sample, nanoseconds; None if it cannot be.

        Suspect stamps are counted in `refused`. None is also a time that would precede the last one of its kind.

        If the first samples were read late, the offset decreases by much; samples whose time would then precede their
        predecessor are dropped.

        Args:
            stamp: the sensor's counter, in [0, 2^32).
            arrival_ns: rig time at which the sample was read.
            kind: of the report; stamps rise within a kind, and may differ between kinds.
        """
        if self._stamp is None:
            self._begin(stamp, arrival_ns)
        step_ns = self._step_ns(self._stamp or 0, stamp)
        last = self._last.get(kind)
        if not self._follows(step_ns, last):
            if not self._confirmed(stamp, kind):
                self.refused += 1
                return None
            self._begin(stamp, arrival_ns)
            step_ns, last = 0, None
        self._doubted.pop(kind, None)
        device_ns = self._device_ns + step_ns
        if step_ns >= 0:
            self._stamp, self._device_ns = stamp, device_ns
        if abs(arrival_ns - self._start_ns - device_ns - self._offset_ns) > _LONGEST_NS:
            self._begin(stamp, arrival_ns)
            device_ns, step_ns, last = 0, 0, None
        drift_ns = _DRIFT * max(step_ns, 0)
        self._offset_ns = min(self._offset_ns + drift_ns, arrival_ns - self._start_ns - device_ns)
        t_ns = self._start_ns + device_ns + round(self._offset_ns)
        if last is not None and t_ns < last[1] + (device_ns - last[0]) // 2:
            return None
        self._last[kind] = device_ns, t_ns
        return t_ns

    def _follows(self, step_ns: int, last: tuple[int, int] | None) -> bool:
        """Whether a sample this much after the newest one of any kind can be the next of its own kind."""
        if last is None:
            # Reports of one kind may be older than those of another by this much: ten samples of a sensor
            # at 100 Hz.
            return -100_000_000 <= step_ns <= _LONGEST_NS
        return step_ns <= _LONGEST_NS and self._device_ns + step_ns >= last[0]

    def _confirmed(self, stamp: int, kind: bytes) -> bool:
        """Whether enough suspect stamps of a kind agree with one another by now: the sensor has restarted."""
        doubted = self._doubted.setdefault(kind, [])
        if doubted and not 0 <= self._step_ns(doubted[-1], stamp) <= _LONGEST_NS:
            doubted.clear()
        doubted.append(stamp)
        # Number of consecutive suspect stamps, consistent with each other, that mean that the sensor has
        # restarted.
        return len(doubted) >= 5

    def _begin(self, stamp: int, arrival_ns: int) -> None:
        # Offsets are relative to the start, because a float cannot represent nanoseconds since the epoch.
        self._stamp, self._start_ns, self._device_ns, self._offset_ns = stamp, arrival_ns, 0, 0.0
        self._last.clear()
        self._doubted.clear()

    def _step_ns(self, before: int, after: int) -> int:
        """Return the time from one stamp to another, nanoseconds: the shorter way around, negative when it is back."""
        return ((after - before + _WRAP // 2) % _WRAP - _WRAP // 2) * self._tick_ns


# The text protocol of a BNO080 on a serial line; see docs/feet.md.
#
# A line is `timestamp L x y z;` (linear acceleration, m/s², sensor frame) or `timestamp R i j k real;` (rotation vector
# as a quaternion, sensor to a level world). The line has no checksum: what is not a whole line is dropped, and values
# that no sensor can send are. The timestamp counts milliseconds or microseconds; which, the spacing of the lines tells.

_LINE: Final = re.compile(
    rb"(\d{1,10})[\s,]+([LR])[\s,:]+(-?\d+(?:\.\d*)?(?:[eE]-?\d+)?(?:[\s,]+-?\d+(?:\.\d*)?(?:[eE]-?\d+)?){2,3})[\s,]*"
)
_LONGEST_LINE: Final = 200
"""Bytes without a semicolon: noise, or another baud rate."""
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
        # M/s² per axis: 16 g, the end of the sensor's scale.
        return len(values) == 3 and max(abs(value) for value in values) <= 160.0
    return len(values) == 4 and abs(math.sqrt(sum(value * value for value in values)) - 1.0) <= _UNIT_BAND


def encode_text(stamp: int, acceleration: _Values, quaternion_xyzw: _Values) -> bytes:
    """Return the two lines of one sample, as the sensor sends them."""
    a = " ".join(f"{value:.3f}" for value in acceleration)
    q = " ".join(f"{value:.5f}" for value in quaternion_xyzw)
    return f"{stamp} L {a};\n{stamp} R {q};\n".encode()


# RHOT's own binary protocol for sensors that send 400 samples a second; see docs/feet.md.
#
# A frame is 30 bytes, little-endian: the sync bytes A5 5A, the length of the payload (24), a sequence number that wraps
# at 256, the payload, and a CRC-16 (CCITT, start value FFFF) of everything between sync bytes and CRC. The payload:
# timestamp in microseconds (uint32, wraps), specific force (3 int16, 1/200 m/s²), angular rate (3 int16, 1/900 rad/s),
# orientation (4 int16, i j k real, 1/16384; all 0 when the sensor has none).

SYNC: Final = b"\xa5\x5a"
FORCE_STEP: Final = 1.0 / 200.0
"""m/s²: ±163 m/s² in 16 bits."""
RATE_STEP: Final = 1.0 / 900.0
"""rad/s: ±36 rad/s (2086 °/s) in 16 bits."""
QUATERNION_STEP: Final = 1.0 / 16384.0
_HEAD: Final = struct.Struct("<BB")
_PAYLOAD: Final = struct.Struct("<I10h")
_CRC: Final = struct.Struct("<H")
_SIZE: Final = len(SYNC) + _HEAD.size + _PAYLOAD.size + _CRC.size


class BinaryDecoder:
    """Bytes of the binary protocol to samples; keeps what is incomplete for the next call."""

    def __init__(self) -> None:
        self._rest = b""
        self._clock = DeviceClock(1_000)
        self._converter = RawImuConverter()
        self._sequence: int | None = None
        self._damaged = 0
        self.lost = 0

    @property
    def faults(self) -> int:
        """Frames so far that were damaged, or whose stamp cannot be."""
        return self._damaged + self._clock.refused

    def decode(self, data: bytes, arrival_ns: int) -> ImuSamples:
        """Return the samples that are complete now.

        Args:
            data: as read from the line.
            arrival_ns: rig time of the reading.
        """
        buffer, at = self._rest + data, 0
        times: list[int] = []
        rows: list[tuple[int, ...]] = []
        while (at := buffer.find(SYNC, at)) >= 0 and len(buffer) - at >= _SIZE:
            frame = buffer[at : at + _SIZE]
            if not _intact(frame):
                self._damaged += 1
                # The sync bytes may have been values: the next frame can begin right behind them.
                at += 1
                continue
            at += _SIZE
            self._count(frame[3])
            stamp, *values = _PAYLOAD.unpack_from(frame, len(SYNC) + _HEAD.size)
            t_ns = self._clock.to_rig_ns(stamp, arrival_ns)
            if t_ns is not None:
                times.append(t_ns)
                rows.append(tuple(values))
        # The last byte may be the first of the sync bytes.
        self._rest = buffer[at:] if at >= 0 else buffer[-1:]
        return self._samples(times, rows)

    def _samples(self, times: list[int], rows: list[tuple[int, ...]]) -> ImuSamples:
        if not times:
            return ImuSamples.none()
        table = np.array(rows, dtype=np.float64)
        own = self._converter.convert(np.array(times), table[:, :3] * FORCE_STEP, table[:, 3:6] * RATE_STEP)
        sizes = np.linalg.norm(table[:, 6:], axis=1, keepdims=True)
        given = np.where(sizes > 0.0, table[:, 6:] / np.maximum(sizes, 1.0), own.orientation_xyzw)
        return ImuSamples(own.t_ns, own.specific_force, own.angular_rate, given)

    def _count(self, sequence: int) -> None:
        if self._sequence is not None:
            self.lost += (sequence - self._sequence - 1) % 256
        self._sequence = sequence


def _intact(frame: bytes) -> bool:
    (crc,) = _CRC.unpack(frame[-_CRC.size :])
    return frame[2] == _PAYLOAD.size and binascii.crc_hqx(frame[2 : -_CRC.size], 0xFFFF) == crc


def encode_binary(
    sequence: int,
    stamp_us: int,
    specific_force: FloatArray,
    angular_rate: FloatArray,
    quaternion_xyzw: Sequence[float] | None = None,
) -> bytes:
    """Return one frame, as a sensor sends it; values beyond the scale are clipped.

    Args:
        sequence: wraps at 256.
        stamp_us: microseconds, wraps at 2^32.
        specific_force: (3,) m/s².
        angular_rate: (3,) rad/s.
        quaternion_xyzw: orientation, if the sensor has one.
    """
    quaternion = np.zeros(4) if quaternion_xyzw is None else np.array(quaternion_xyzw) / QUATERNION_STEP
    values = np.concatenate([specific_force / FORCE_STEP, angular_rate / RATE_STEP, quaternion])
    whole = np.clip(np.rint(values), -32768, 32767).astype(int).tolist()
    body = _HEAD.pack(_PAYLOAD.size, sequence % 256) + _PAYLOAD.pack(stamp_us % (1 << 32), *whole)
    return SYNC + body + _CRC.pack(binascii.crc_hqx(body, 0xFFFF))


_LOG = logging.getLogger(__name__)

_SILENCE_NS = 2_000_000_000
"""A sensor that sends nothing that can be read for so long is gone, or speaks otherwise than it should."""


class _Decoder(Protocol):
    @property
    def faults(self) -> int: ...

    def decode(self, data: bytes, arrival_ns: int) -> ImuSamples: ...


def _import_serial() -> Any:
    try:
        return importlib.import_module("serial")
    except ImportError as error:
        raise DeviceError(
            "sensors on a serial port need the Python package `pyserial`; install it with: pip install 'rhot[feet]'"
        ) from error


class SerialSource:
    """Reads what has arrived whenever it is asked, without waiting."""

    def __init__(self, config: ImuConfig) -> None:
        """Name the port and what is spoken on it."""
        self._config = config
        self._port: Any = None
        self._decoder: _Decoder = self._fresh_decoder()
        self._heard_ns: int | None = None

    @property
    def faults(self) -> int:
        """Lines or frames since the port was opened that could not be read."""
        return self._decoder.faults

    def open(self, start_ns: int) -> None:
        """Open the port.

        Raises:
            DeviceError: there is no such port, or it is in use.
        """
        serial = _import_serial()
        config = self._config
        self.close()
        try:
            self._port = serial.Serial(config.device, config.baud, timeout=0, exclusive=True)
        except Exception as error:
            # Not only OSError and ValueError: a device that goes during the opening ends in a termios.error.
            raise DeviceError(
                f"the inertial sensor at {config.device} ({config.baud} baud) cannot be opened: {error}; is it plugged "
                "in, is no other program using it, and may you read the port (group dialout)?"
            ) from error
        self._decoder = self._fresh_decoder()
        # From the first reading on: the session may have begun long before the sensor was plugged in.
        self._heard_ns = None

    def read(self, now_ns: int) -> ImuSamples:
        """Return the samples that arrived since the last call.

        Raises:
            DeviceError: the port is closed or gone, or nothing readable has come for two seconds.
        """
        config, port = self._config, self._port
        if port is None:
            raise DeviceError(f"the inertial sensor at {config.device} is not open")
        try:
            data = port.read(port.in_waiting or 1)
        except Exception as error:
            # OSError, termios.error; a port that another thread closes under the reader: a TypeError of pyserial.
            raise DeviceError(f"the inertial sensor at {config.device} went away: {error}; plug it in again") from error
        samples = self._decoder.decode(data, now_ns)
        if len(samples) or self._heard_ns is None or now_ns < self._heard_ns:
            self._heard_ns = now_ns
        elif now_ns - self._heard_ns > _SILENCE_NS:
            raise DeviceError(
                f"the inertial sensor at {config.device} has sent nothing readable for "
                f"{(now_ns - self._heard_ns) / 1e9:.1f} s ({self._decoder.faults} faulty lines): is it on, is its baud "
                f"rate {config.baud}, and does it send format = {config.format!r}?"
            )
        return samples

    def close(self) -> None:
        """Close the port."""
        port, self._port = self._port, None
        if port is not None:
            try:
                port.close()
            except Exception as error:
                # What is pulled out cannot be closed.
                _LOG.debug("inertial sensor at %s: close: %s", self._config.device, error)

    def _fresh_decoder(self) -> _Decoder:
        return TextDecoder(self._config.rate_hz) if self._config.format == "text" else BinaryDecoder()
