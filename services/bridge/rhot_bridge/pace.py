"""When a frame goes out."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

LEADER_ABSENT_NS: Final = 100_000_000
"""Whoever has been silent for so long no longer leads: six frames at 60 Hz."""


class Pace:
    """Caps the rate without holding anything back.

    A frame goes out with a sample of the kind that leads: the first kind in the target's order of which something has
    come lately. So the hand, where there is one, waits for nobody; what else has come rides along. A sample that comes
    before the cap allows is not sent: the next one replaces it. Up to one period is made up for, so that samples at
    100 Hz and a cap of 90 Hz give 90 Hz, not 50.
    """

    def __init__(self, rate_hz: float, leads: Sequence[str]) -> None:
        """Prepare.

        Args:
            rate_hz: most frames per second.
            leads: kinds (`hand`, `foot`, …), the most important first.
        """
        self._period_ns = round(1e9 / rate_hz)
        self._rank = {kind: rank for rank, kind in enumerate(leads)}
        self._heard_ns = [-LEADER_ABSENT_NS] * len(self._rank)
        self._due_ns = 0
        self.sent_ns = 0

    def due(self, now_ns: int, kind: str | None = None) -> bool:
        """Return whether a frame may go out now.

        Args:
            now_ns: monotonic.
            kind: what has just come; None = nothing, a repetition.
        """
        if kind is not None:
            rank = self._rank.get(kind)
            if rank is None:
                return False
            self._heard_ns[rank] = now_ns
            for heard_ns in self._heard_ns[:rank]:
                if now_ns - heard_ns < LEADER_ABSENT_NS:
                    return False
        return now_ns >= self._due_ns

    def sent(self, now_ns: int) -> None:
        """Count a frame."""
        self._due_ns = max(self._due_ns + self._period_ns, now_ns)
        self.sent_ns = now_ns
