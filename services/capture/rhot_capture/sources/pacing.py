"""Delivering frames when they are due, wakeable by `close`."""

from __future__ import annotations

import threading
from typing import Final

from rhot.clock import NodeClock

_CHUNK_S: Final = 0.5


class Pacer:
    """Waits for moments of a node's clock; a wait ends early when the pacer is stopped."""

    def __init__(self, clock: NodeClock) -> None:
        self._clock = clock
        self._stopped = threading.Event()

    @property
    def stopped(self) -> bool:
        """Whether `stop` was called."""
        return self._stopped.is_set()

    def now_ns(self) -> int:
        """Return the node's time."""
        return self._clock.now_ns()

    def wait_until(self, due_ns: int) -> bool:
        """Wait for a moment; return whether it came before the pacer was stopped."""
        while not self._stopped.is_set():
            remaining_s = 1e-9 * (due_ns - self._clock.now_ns())
            if remaining_s <= 0.0:
                return True
            # In pieces, because the node's clock may run at another rate than the one that the wait uses.
            self._stopped.wait(min(remaining_s, _CHUNK_S))
        return False

    def restart(self) -> None:
        """Be ready for use again."""
        self._stopped.clear()

    def stop(self) -> None:
        """End the present wait and all later ones."""
        self._stopped.set()
