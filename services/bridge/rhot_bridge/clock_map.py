"""From the rig clock to another clock of this machine, for programs that keep their own time.

With r and l the readings of both clocks at one moment, o = l − r is their offset, and a sample of rig time s is at

    s + ô

on the other clock. r is read between l₀ and l₁, so o lies between l₀ − r and l₁ − r. Where ô lies there, too, the
reading tells nothing new: a process that was interrupted between two of its lines moves no stamp. Else ô follows the
nearer end smoothly: it closes 1 − exp(−Δt/τ) of the difference after Δt. The rig clock of this machine is itself an
estimate that moves by microseconds as it learns; a recording must not jump with it. A difference of more than
`STEP_NS` is no estimate's, but a clock that was set: ô follows at once.
"""

from __future__ import annotations

import math
from typing import Final

TIME_CONSTANT_NS: Final = 10_000_000_000
"""A rig clock that drifts by 40 ppm against this machine's leaves 0.4 ms behind in that time; see `SimConfig`."""
STEP_NS: Final = 20_000_000
"""Ten times what `rhot doctor` calls a badly known clock."""


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
        """Take a reading of the rig clock between two of the other clock."""
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
        """Return a moment of the rig clock on the other clock.

        Raises:
            ValueError: no clock has been read yet.
        """
        if self._offset_ns is None:
            raise ValueError("the clocks have not been read yet")
        return rig_ns + round(self._offset_ns)
