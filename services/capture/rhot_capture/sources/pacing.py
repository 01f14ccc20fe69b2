"""Waiting for due times, interruptible by `close`."""

from __future__ import annotations

import threading

from rhot.clock import NodeClock


class Pacer:
    """Waits until times of a node's clock; `stop` ends a wait early."""

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
        """Wait until a time; return False if the pacer was stopped before."""
        while not self._stopped.is_set():
            remaining_s = 1e-9 * (due_ns - self._clock.now_ns())
            if remaining_s <= 0.0:
                return True
            # In steps, because the node's clock may run at another rate than the clock of the wait.
            chunk_s = 0.5
            self._stopped.wait(min(remaining_s, chunk_s))
        return False

    def restart(self) -> None:
        """Reset after `stop`."""
        self._stopped.clear()

    def stop(self) -> None:
        """End the current wait and all later ones at once."""
        self._stopped.set()
