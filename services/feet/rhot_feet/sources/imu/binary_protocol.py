"""RHOT's own binary protocol for sensors that send 400 samples a second; see docs/feet.md.

A frame is 30 bytes, little-endian: the sync bytes A5 5A, the length of the payload (24), a sequence number that wraps
at 256, the payload, and a CRC-16 (CCITT, start value FFFF) of everything between sync bytes and CRC. The payload:
timestamp in microseconds (uint32, wraps), specific force (3 int16, 1/200 m/s²), angular rate (3 int16, 1/900 rad/s),
orientation (4 int16, i j k real, 1/16384; all 0 when the sensor has none).
"""

from __future__ import annotations

import binascii
import struct
from collections.abc import Sequence
from typing import Final

import numpy as np

from rhot.arrays import FloatArray
from rhot_feet.imu.conversion import RawImuConverter
from rhot_feet.imu.samples import ImuSamples
from rhot_feet.sources.imu.device_clock import DeviceClock

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
