"""What a bridge has opened for the names that it sends, such as streams and topics."""

from __future__ import annotations

import asyncio
import time
from collections.abc import Callable, Iterator
from typing import Final, Generic, TypeVar

SILENT_NS: Final = 5_000_000_000
"""A name that has brought nothing for so long makes room for another."""

T = TypeVar("T")


class Opened(Generic[T]):
    """Things by name, at most so many: names are an outsider's choice. Iterates over names, the most silent first."""

    def __init__(self, most: int) -> None:
        """Begin with none."""
        self._most = most
        # In the order of when each name was heard last.
        self._things: dict[str, tuple[T, int]] = {}

    def __iter__(self) -> Iterator[str]:
        """Return the names."""
        return iter(self._things)

    def add(self, name: str, thing: T) -> None:
        """Keep what was opened for a name, which counts as heard."""
        self._things.pop(name, None)
        self._things[name] = thing, time.monotonic_ns()

    def heard(self, name: str) -> T | None:
        """Note that a name has brought something, and return what is open for it; none where nothing is."""
        if name not in self._things:
            return None
        thing, _ = self._things[name]
        self.add(name, thing)
        return thing

    def make_room(self, opening: int, end: Callable[[T], None]) -> bool:
        """Return whether one more has room, perhaps in place of one that is silent.

        Args:
            opening: how many more are on their way.
            end: takes back what is silent; called on a thread, and the last reference to it ends there.
        """
        if len(self._things) + opening < self._most:
            return True
        silent = next(iter(self._things), None)
        if silent is None or time.monotonic_ns() - self._things[silent][1] < SILENT_NS:
            return False
        held = [self._things.pop(silent)[0]]
        # Nobody waits for it: what is left of it ends with the bridge.
        asyncio.get_running_loop().run_in_executor(None, lambda: end(held.pop()))
        return True

    def clear(self) -> list[T]:
        """Forget all, and return what was open."""
        things = [thing for thing, _ in self._things.values()]
        self._things.clear()
        return things
