"""Telling stamps that cannot be true from those that can, without a clock in common with whoever made them.

The offset of a picture is its stamp less its arrival. A picture may come late by any time, which makes the offset
smaller, but never before it was taken: the largest offset that was confirmed is the clocks' difference, and one that
exceeds it by more than the tolerance claims a time that has not come yet.
"""

from __future__ import annotations

import statistics
from typing import Final

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
