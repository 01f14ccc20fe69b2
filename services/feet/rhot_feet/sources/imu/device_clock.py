"""The clock of a sensor on a wire, mapped to the rig clock.

A sensor stamps its samples with a 32-bit counter that wraps around, and they arrive some time later. A delay is never
negative, so the smallest offset arrival − stamp is closest to the true one; it is kept, and rises slowly to allow for
the drift between two oscillators:

    offset ← min(offset + drift · elapsed, arrival − stamp).

The shortest delay itself (a millisecond or so on a serial line) stays in the offset.
"""

from __future__ import annotations

from typing import Final

_WRAP: Final = 1 << 32
_DRIFT: Final = 100e-6
"""Largest relative drift between two oscillators."""
_LONGEST_NS: Final = 1_000_000_000
"""A stamp that jumps by more, or backwards, is suspect. A sample that arrives this much earlier or later than expected
means that the rig clock was set, because no serial line delays samples by a second."""
_CONFIRMED: Final = 5
"""Number of consecutive suspect stamps, consistent with each other, that mean that the sensor has restarted."""


class DeviceClock:
    """Unwraps the counter of one sensor and maps it to rig time; reads no clock itself."""

    def __init__(self, tick_ns: int) -> None:
        """Set the counter's unit, nanoseconds."""
        self._tick_ns = tick_ns
        self._stamp: int | None = None
        self._start_ns = 0
        self._device_ns = 0
        self._offset_ns = 0.0
        self._doubted: list[int] = []
        self._last_ns = 0

    def to_rig_ns(self, stamp: int, arrival_ns: int) -> int | None:
        """Return the rig time of a sample, nanoseconds; None if its stamp is suspect or would precede the last one.

        If the first samples were read late, the offset decreases by much; samples whose time would then precede their
        predecessor are dropped.

        Args:
            stamp: the sensor's counter, in [0, 2^32).
            arrival_ns: rig time at which the sample was read.
        """
        if self._stamp is None:
            self._begin(stamp, arrival_ns)
        step_ns = self._step_ns(self._stamp or 0, stamp)
        if step_ns is None:
            if self._doubted and self._step_ns(self._doubted[-1], stamp) is None:
                self._doubted.clear()
            self._doubted.append(stamp)
            if len(self._doubted) < _CONFIRMED:
                return None
            self._begin(stamp, arrival_ns)
            step_ns = 0
        self._doubted.clear()
        self._stamp = stamp
        self._device_ns += step_ns
        if abs(arrival_ns - self._start_ns - self._device_ns - self._offset_ns) > _LONGEST_NS:
            self._begin(stamp, arrival_ns)
            step_ns = self._last_ns = 0
        self._offset_ns = min(self._offset_ns + _DRIFT * step_ns, arrival_ns - self._start_ns - self._device_ns)
        t_ns = self._start_ns + self._device_ns + round(self._offset_ns)
        if t_ns < self._last_ns + step_ns // 2:
            return None
        self._last_ns = t_ns
        return t_ns

    def _begin(self, stamp: int, arrival_ns: int) -> None:
        # Offsets are relative to the start, because a float cannot represent nanoseconds since the epoch.
        self._stamp, self._start_ns, self._device_ns, self._offset_ns = stamp, arrival_ns, 0, 0.0

    def _step_ns(self, before: int, after: int) -> int | None:
        step_ns = (after - before) % _WRAP * self._tick_ns
        return step_ns if step_ns <= _LONGEST_NS else None
