"""Listening to a running rig while a person calibrates: tasks that end together, and what is missing meanwhile."""

from __future__ import annotations

import asyncio
import time
from collections.abc import AsyncIterator, Callable, Coroutine, Mapping, Sequence
from contextlib import asynccontextmanager
from typing import Any, Final

from rhot.errors import BusError

HINT_S: Final = 0.5
"""Between two looks at what is missing."""

Hint = Callable[[str], None]


@asynccontextmanager
async def listening(*works: Coroutine[Any, Any, None]) -> AsyncIterator[list[asyncio.Task[None]]]:
    """Run coroutines that listen; they are cancelled and have ended when the block is left."""
    tasks = [asyncio.create_task(work) for work in works]
    try:
        yield tasks
    finally:
        for task in tasks:
            task.cancel()
        await asyncio.gather(*tasks, return_exceptions=True)


class StreamWatch:
    """Says what the person should do while streams are listened to, and ends the wait for one that stays silent.

    Args:
        tasks: that listen.
        heard: keys that something came on; filled by them.
        services: key to the service that publishes it.
        patience_s: how long a key may stay silent at the beginning.
        remedy: what to look after when one does, behind the question whether its service is running.
        hint: called with what the person should do, whenever that changes.
    """

    def __init__(
        self,
        tasks: Sequence[asyncio.Task[None]],
        heard: set[str],
        services: Mapping[str, str],
        patience_s: float,
        remedy: str,
        hint: Hint,
    ) -> None:
        self._tasks, self._heard, self._services = tasks, heard, services
        self._patience_s, self._remedy, self._hint = patience_s, remedy, hint
        self._begun, self._hinted = time.monotonic(), ""

    def look(self, advice: Callable[[], str]) -> None:
        """Look once, every `HINT_S` or so.

        Args:
            advice: what the person should do when every key is heard; empty = nothing.

        Raises:
            BusError: a key has stayed silent for too long, or the connection was closed.
        """
        silent = [key for key in self._services if key not in self._heard]
        if silent and time.monotonic() - self._begun > self._patience_s:
            raise BusError(
                f"nothing was published on {silent[0]} for {self._patience_s:.0f} s; is "
                f"`rhot {self._services[silent[0]]}` running{self._remedy}?"
            )
        for task in self._tasks:
            if task.done():
                task.result()
                raise BusError("the connection to the router was closed")
        now = f"nothing on {silent[0]} yet" if silent else advice()
        if now and now != self._hinted:
            self._hint(now)
        self._hinted = now
