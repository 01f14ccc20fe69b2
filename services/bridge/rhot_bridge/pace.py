"""Decides when a frame is sent."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

KIND_ABSENT_NS: Final = 100_000_000
"""A kind without a sample for this long no longer blocks lower ones: six frames at 60 Hz."""


class Pace:
    """Limits the rate without delaying samples.

    A frame is sent with a sample of the triggering kind: the first kind, in the target's order, with a recent sample.
    So a hand is sent at once, together with the newest samples of other kinds. A sample that comes before the rate
    limit allows is not sent: the next one replaces it. Up to one period is made up for, so that samples at 100 Hz and
    a limit of 90 Hz give 90 Hz, not 50.
    """

    def __init__(self, rate_hz: float, triggers: Sequence[str]) -> None:
        """Set the limit.

        Args:
            rate_hz: most frames per second.
            triggers: kinds of samples (`hand`, `foot`, …) that trigger a frame, by priority.
        """
        self._period_ns = round(1e9 / rate_hz)
        self._rank = {kind: rank for rank, kind in enumerate(triggers)}
        self._heard_ns = [-KIND_ABSENT_NS] * len(self._rank)
        self._due_ns = 0
        self.sent_ns = 0

    def due(self, now_ns: int, kind: str | None = None) -> bool:
        """Return whether a frame may go out now.

        Args:
            now_ns: monotonic clock.
            kind: of the sample that has just arrived; None for a repetition without a new sample.
        """
        if kind is not None:
            rank = self._rank.get(kind)
            if rank is None:
                return False
            self._heard_ns[rank] = now_ns
            for heard_ns in self._heard_ns[:rank]:
                if now_ns - heard_ns < KIND_ABSENT_NS:
                    return False
        return now_ns >= self._due_ns

    def sent(self, now_ns: int) -> None:
        """Note that a frame was sent."""
        self._due_ns = max(self._due_ns + self._period_ns, now_ns)
        self.sent_ns = now_ns
