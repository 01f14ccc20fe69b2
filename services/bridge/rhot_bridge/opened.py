"""Resources that a bridge opens by name, such as streams and topics."""

from __future__ import annotations

import asyncio
import time
from collections.abc import Callable, Iterator
from typing import Final, Generic, TypeVar

SILENT_NS: Final = 5_000_000_000
"""A resource that has not been used for this long may be closed to make room for another."""

T = TypeVar("T")


class Opened(Generic[T]):
    """A bounded map from names, which come from messages, to resources; iterates over names, least recently used first.

    Args:
        most: largest number of resources.
    """

    def __init__(self, most: int) -> None:
        self._most = most
        # Ordered by the last use.
        self._things: dict[str, tuple[T, int]] = {}

    def __iter__(self) -> Iterator[str]:
        """Return the names, least recently used first."""
        return iter(self._things)

    def add(self, name: str, thing: T) -> None:
        """Store the resource of a name; this counts as a use."""
        self._things.pop(name, None)
        self._things[name] = thing, time.monotonic_ns()

    def get(self, name: str) -> T | None:
        """Return the resource of a name and count this as a use; None if there is none."""
        if name not in self._things:
            return None
        thing, _ = self._things[name]
        self.add(name, thing)
        return thing

    def make_room(self, opening: int, end: Callable[[T], None]) -> bool:
        """Return whether there is room for one more, after closing an unused one if necessary.

        Args:
            opening: how many more are being opened.
            end: closes a resource; called on a worker thread, which also drops the last reference to it.
        """
        if len(self._things) + opening < self._most:
            return True
        silent = next(iter(self._things), None)
        if silent is None or time.monotonic_ns() - self._things[silent][1] < SILENT_NS:
            return False
        held = [self._things.pop(silent)[0]]
        # Not awaited: it does not raise, and what remains ends with the bridge.
        asyncio.get_running_loop().run_in_executor(None, lambda: end(held.pop()))
        return True

    def clear(self) -> list[T]:
        """Remove and return all resources."""
        things = [thing for thing, _ in self._things.values()]
        self._things.clear()
        return things
