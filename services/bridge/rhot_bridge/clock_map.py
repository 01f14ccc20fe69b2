"""Maps the rig clock to another clock of this machine, for programs with their own clock.

With r and l the readings of both clocks at one moment, o = l − r is their offset. A sample of rig time s has the
time

    s + ô

on the other clock. r is read between l₀ and l₁, so o lies between l₀ − r and l₁ − r. If ô lies in this interval, it
is kept, so that an interruption of the process between two readings does not change time stamps. Otherwise ô
approaches the nearer bound by 1 − exp(−Δt/τ) of the difference after Δt: the rig clock of this machine is itself an
estimate that changes by microseconds, and a recording must not jump with it. Before τ has passed, the time since the
first reading stands for it: what a busy machine's rig clock was off by when it joined is gone within seconds. A
difference of more than `STEP_NS` means that a clock was set; ô then follows at once.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Final

from rhot.clock import RigClock

_FIRST_READINGS: Final = 5
TIME_CONSTANT_NS: Final = 10_000_000_000
"""τ. A rig clock that drifts by 40 ppm against this machine's clock leaves an error of 0.4 ms; see `SimConfig`."""
STEP_NS: Final = 20_000_000
"""Ten times the uncertainty at which `rhot doctor` warns about a clock."""


class ClockMap:
    """The smoothed offset between two clocks; all times are integer nanoseconds."""

    def __init__(self) -> None:
        self._offset_ns: float | None = None
        self._first_ns = self._read_ns = 0

    @property
    def ready(self) -> bool:
        """Whether both clocks have been read."""
        return self._offset_ns is not None

    def follow(self, clock: RigClock | None, local_ns: Callable[[], int]) -> bool:
        """Read both clocks; return whether times can be mapped.

        Args:
            clock: the rig clock, None before it is there.
            local_ns: reads the other clock.
        """
        if clock is None or not clock.ready:
            return False

        def reading() -> tuple[int, int, int]:
            before_ns, rig_ns, after_ns = local_ns(), clock.now_ns(), local_ns()
            return rig_ns, before_ns, after_ns

        # The first reading is not smoothed: the shortest of several is used, which contains no interruption.
        readings = [reading() for _ in range(1 if self.ready else _FIRST_READINGS)]
        self.read(*min(readings, key=lambda one: one[2] - one[1]))
        return True

    def read(self, rig_ns: int, before_ns: int, after_ns: int) -> None:
        """Update the offset with a reading of the rig clock between two readings of the other clock."""
        local_ns = (before_ns + after_ns) // 2
        if self._offset_ns is None:
            self._offset_ns, self._first_ns = float(local_ns - rig_ns), local_ns
        last = self._offset_ns
        nearest = min(max(last, before_ns - rig_ns), after_ns - rig_ns)
        if abs(nearest - last) > STEP_NS:
            self._offset_ns = float(local_ns - rig_ns)
        else:
            constant_ns = min(TIME_CONSTANT_NS, max(1, local_ns - self._first_ns))
            share = 1.0 - math.exp(-max(0, local_ns - self._read_ns) / constant_ns)
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
