"""Maps the rig clock to another clock of this machine, for programs with their own clock.

With r and l the readings of both clocks at one moment, o = l − r is their offset. A sample of rig time s has the time

    s + ô

on the other clock. r is read between l₀ and l₁, so o lies between l₀ − r and l₁ − r. If ô lies in this interval, it is
kept, so that an interruption of the process between two readings does not change time stamps. Otherwise ô approaches
the nearer bound by 1 − exp(−Δt/τ) of the difference after Δt: the rig clock of this machine is itself an estimate that
changes by microseconds, and a recording must not jump with it. A difference of more than `STEP_NS` means that a clock
was set; ô then follows at once.
"""

from __future__ import annotations

import math
from typing import Final

TIME_CONSTANT_NS: Final = 10_000_000_000
"""τ. A rig clock that drifts by 40 ppm against this machine's clock leaves an error of 0.4 ms; see `SimConfig`."""
STEP_NS: Final = 20_000_000
"""Ten times the uncertainty at which `rhot doctor` warns about a clock."""


class ClockMap:
    """The smoothed offset between two clocks; all times are integer nanoseconds."""

    def __init__(self) -> None:
        self._offset_ns: float | None = None
        self._read_ns = 0

    @property
    def ready(self) -> bool:
        """Whether both clocks have been read."""
        return self._offset_ns is not None

    def read(self, rig_ns: int, before_ns: int, after_ns: int) -> None:
        """Update the offset with a reading of the rig clock between two readings of the other clock."""
        local_ns = (before_ns + after_ns) // 2
        last = float(local_ns - rig_ns) if self._offset_ns is None else self._offset_ns
        nearest = min(max(last, before_ns - rig_ns), after_ns - rig_ns)
        if abs(nearest - last) > STEP_NS:
            self._offset_ns = float(local_ns - rig_ns)
        else:
            share = 1.0 - math.exp(-max(0, local_ns - self._read_ns) / TIME_CONSTANT_NS)
            self._offset_ns = last + share * (nearest - last)
        self._read_ns = local_ns

    def to_local_ns(self, rig_ns: int) -> int:
        """Return the other clock's time of a rig time.

        Raises:
            ValueError: no clock has been read yet.
        """
        if self._offset_ns is None:
            raise ValueError("the clocks have not been read yet")
        return rig_ns + round(self._offset_ns)
