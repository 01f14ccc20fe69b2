"""The clock of a sensor on a wire, mapped to the rig clock.

A sensor stamps its samples with a 32-bit counter that wraps around, and they arrive some time later. A delay is never
negative, so the smallest offset arrival − stamp is closest to the true one; it is kept, and rises slowly to allow for
the drift between two oscillators:

    offset ← min(offset + drift · elapsed, arrival − stamp).

The shortest delay itself (a millisecond or so on a serial line) stays in the offset.

A sensor may send several kinds of report, each with the stamp of its own measurement. Within one kind stamps only rise;
between kinds they may step back a little.
"""

from __future__ import annotations

from typing import Final

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
