"""Which frames a simulated camera draws on a machine that cannot draw them all.

A tracker does far better with every second frame than with frames that fall out at random: a point needs both cameras
at one moment, and a share p of frames lost at random leaves only (1 − p)² of the moments.
"""

from __future__ import annotations

from typing import Final

_WINDOW: Final = 60
"""Frames looked at together: a second at 60 Hz."""
_TOO_MANY: Final = 0.2
"""Share of them that came too late to be drawn; a camera then loses 36 % of all moments."""
_MOST: Final = 4
_START: Final = 180
"""Frames after the start that tell nothing: three seconds in which every service loads its modules."""
_FIRST_PATIENCE: Final = 180
_MOST_PATIENCE: Final = 1440
"""Frames drawn in time before more are tried again, doubled each time that was too soon."""


class Stride:
    """How many frames lie from one that is drawn to the next.

    Attributes:
        value: 1 (all), 2 or 4.
    """

    def __init__(self) -> None:
        self.value = 1
        self._waiting = _START
        self._looked = 0
        self._late = 0
        self._in_time = 0
        self._patience = _FIRST_PATIENCE

    def next_after(self, number: int) -> int:
        """Return the number of the frame to draw after another: a multiple of the stride, the same in all cameras."""
        return (number // self.value + 1) * self.value

    def count(self, late: bool) -> bool:
        """Take whether a frame was too late to be drawn; return whether the stride has changed."""
        if self._waiting:
            self._waiting -= 1
            return False
        self._looked += 1
        self._late += late
        self._in_time = 0 if late else self._in_time + 1
        if self._late > _TOO_MANY * _WINDOW and self.value < _MOST:
            self._begin(2 * self.value)
            return True
        if self._looked >= _WINDOW:
            self._looked = self._late = 0
        if self.value > 1 and self._in_time * self.value >= self._patience:
            self._patience = min(2 * self._patience, _MOST_PATIENCE)
            self._begin(self.value // 2)
            return True
        return False

    def _begin(self, value: int) -> None:
        self.value = value
        self._looked = self._late = self._in_time = 0
