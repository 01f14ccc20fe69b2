"""The start signal as a service knows it: the newest word wins, however it arrived."""

from __future__ import annotations

import asyncio

from rhot.errors import WireError
from rhot.messages import Control

MAX_AHEAD_NS = 60_000_000_000
"""A start further in the future than this is a mistake or garbage."""


class ControlState:
    """The newest control message; services that join late learn it from those already there."""

    def __init__(self) -> None:
        self._newest: Control | None = None
        self._changed = asyncio.Event()

    @property
    def newest(self) -> Control | None:
        """The message in force."""
        return self._newest

    @property
    def running(self) -> Control | None:
        """The start in force, None when stopped or never started."""
        newest = self._newest
        return newest if newest is not None and newest.action == "start" else None

    def offer(self, control: Control, now_ns: int | None) -> bool:
        """Accept a message if it is newer than the last; return whether it was.

        Args:
            control: the message.
            now_ns: rig time, None where it is not known yet.

        Raises:
            WireError: the message comes from the future, so it would silence every later one.
        """
        if now_ns is not None and max(control.t_ns, control.start_t_ns) > now_ns + MAX_AHEAD_NS:
            ahead_s = (max(control.t_ns, control.start_t_ns) - now_ns) / 1e9
            raise WireError(f"control message lies {ahead_s:.0f} s in the future, at most {MAX_AHEAD_NS / 1e9:.0f} s")
        if self._newest is not None and control.t_ns <= self._newest.t_ns:
            return False
        if (
            control.action == "stop"
            and control.session
            and self._newest is not None
            and control.session != self._newest.session
        ):
            return False
        self._newest = control
        self._changed.set()
        self._changed = asyncio.Event()
        return True

    async def wait_until_not(self, running_session: str | None) -> None:
        """Return once the running session is another one than `running_session` (None = stopped)."""
        while True:
            running = self.running
            if (running.session if running is not None else None) != running_session:
                return
            await self._changed.wait()
