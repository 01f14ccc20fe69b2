"""The start signal as a service knows it: the last word wins, however it arrived and whatever the clocks did meanwhile.

A message that arrives as a broadcast is the newest by its very arrival. One that is learnt from other services may be
older than what is known; its revision says so. Times order nothing: the rig clock may be set back at any moment, and a
message of before would silence all later ones.
"""

from __future__ import annotations

import asyncio
import logging
from typing import Final

from rhot.bus import Answer, Request, message_answer
from rhot.errors import WireError
from rhot.messages import Control, decode
from rhot.service.node import Node

# Start and stop over the bus: hearing broadcasts, asking those who know, answering those who ask.

logger = logging.getLogger(__name__)

CONTROL_KEY: Final = "rhot/control"
_QUERY_INTERVAL_S: Final = 2.0


class ControlLink:
    """Keeps a service's idea of the start signal up to date; what is refused is counted and logged.

    Attributes:
        state: the message in force.
    """

    def __init__(self) -> None:
        self.state = ControlState()

    def follow(self, node: Node, clock_ready: asyncio.Event, tasks: asyncio.TaskGroup) -> None:
        """Hear and ask, in tasks of their own."""
        tasks.create_task(self._follow_broadcasts(node))
        tasks.create_task(self._ask(node))
        tasks.create_task(self._judge(node, clock_ready))

    def answer(self, request: Request) -> Answer | None:
        """Answer a question for the message in force."""
        newest = self.state.newest
        return None if newest is None else message_answer(newest, request)

    async def _follow_broadcasts(self, node: Node) -> None:
        async for sample in node.bus.events(CONTROL_KEY):
            if not sample.deleted:
                self._handle(node, sample.payload, live=True)

    async def _ask(self, node: Node) -> None:
        """Learn the start signal from whoever knows it: for services that join late or missed it."""
        while True:
            for reply in await node.bus.get(CONTROL_KEY, timeout_s=1.0):
                if not reply.error:
                    self._handle(node, reply.payload, live=False)
            await asyncio.sleep(_QUERY_INTERVAL_S)

    async def _judge(self, node: Node, clock_ready: asyncio.Event) -> None:
        """Take a start that came before rig time was known."""
        await clock_ready.wait()
        try:
            if self.state.judge(node.clock.now_ns()):
                self._log()
        except WireError as error:
            node.refuse(CONTROL_KEY, error)

    def _handle(self, node: Node, payload: bytes, *, live: bool) -> None:
        try:
            control = decode(payload, Control)
            if live:
                taken = self.state.receive(control, node.clock.now_ns() if node.clock.ready else None)
            else:
                taken = self.state.learn(control)
        except WireError as error:
            node.refuse(CONTROL_KEY, error)
            return
        if taken:
            self._log()

    def _log(self) -> None:
        newest = self.state.newest
        if newest is not None:
            logger.info("%s %s", newest.action, newest.session)


MAX_OFF_NS: Final = 60_000_000_000
"""A broadcast whose time is further from now than this is a mistake, a replay or garbage; chosen."""
_MOST_AHEAD: Final = 1_000_000
"""A learnt revision further ahead than this is garbage: nobody starts a rig that often while one service is away."""


class ControlState:
    """The control message in force; services that join late learn it from those already there."""

    def __init__(self) -> None:
        self._newest: Control | None = None
        self._unjudged: Control | None = None
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

    def receive(self, control: Control, now_ns: int | None) -> bool:
        """Take a message that was broadcast just now; return whether anything changed.

        A stop is always obeyed, whatever its time says. A start that comes before rig time is known waits for `judge`.

        Args:
            control: the message.
            now_ns: rig time, None where it is not known yet.

        Raises:
            WireError: a start of another time, or the stop of another session.
        """
        newest = self._newest
        if newest is not None and control.model_copy(update={"revision": newest.revision}) == newest:
            return False
        if control.action == "start":
            if now_ns is None:
                self._unjudged = control
                return False
            _check_start(control, now_ns)
        elif control.session and newest is not None and control.session != newest.session:
            raise WireError(f"the stop is for session {control.session}, not for {newest.session or 'a stopped rig'}")
        known = 0 if newest is None else newest.revision
        believable = known < control.revision <= known + _MOST_AHEAD
        self._handle(control if believable else control.model_copy(update={"revision": known + 1}))
        return True

    def judge(self, now_ns: int) -> bool:
        """Take the start that came before rig time was known; return whether there was one.

        Raises:
            WireError: it is of another time.
        """
        waiting, self._unjudged = self._unjudged, None
        return waiting is not None and self.receive(waiting, now_ns)

    def learn(self, control: Control) -> bool:
        """Take a message that another service holds, if it is newer than ours; return whether it was.

        Raises:
            WireError: its revision cannot be true.
        """
        known = 0 if self._newest is None else self._newest.revision
        if control.revision > known + _MOST_AHEAD:
            raise WireError(f"control revision {control.revision} cannot be true; the newest that is known is {known}")
        if self._newest is not None and control.revision <= known:
            return False
        self._handle(control)
        return True

    def _handle(self, control: Control) -> None:
        self._newest, self._unjudged = control, None
        self._changed.set()
        self._changed = asyncio.Event()

    async def wait_until_not(self, running_session: str | None) -> None:
        """Return once the running session is another one than `running_session` (None = stopped)."""
        while True:
            running = self.running
            if (running.session if running is not None else None) != running_session:
                return
            await self._changed.wait()


def _check_start(control: Control, now_ns: int) -> None:
    off_ns = max((control.t_ns - now_ns, control.start_t_ns - now_ns, now_ns - control.t_ns))
    if off_ns > MAX_OFF_NS:
        raise WireError(
            f"the start is {off_ns / 1e9:.0f} s off rig time, at most {MAX_OFF_NS / 1e9:.0f} s is believed: was the "
            "rig clock set, or is it a replay?"
        )


def with_start_in_reach(start: Control, now_ns: int) -> Control:
    """Return a start as it is, or as one of now where its time is further ahead than any sender may choose.

    That happens where the rig clock was set back since: the others run already, and waiting would take that long.
    """
    return start if start.start_t_ns - now_ns <= MAX_OFF_NS else start.model_copy(update={"start_t_ns": now_ns})
