"""Start and stop over the bus: hearing broadcasts, asking those who know, answering those who ask."""

from __future__ import annotations

import asyncio
import logging
from typing import Final

from rhot.bus import Answer, Request, message_answer
from rhot.errors import WireError
from rhot.messages import Control, decode
from rhot.service.control import ControlState
from rhot.service.node import Node

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
                self._take(node, sample.payload, live=True)

    async def _ask(self, node: Node) -> None:
        """Learn the start signal from whoever knows it: for services that join late or missed it."""
        while True:
            for reply in await node.bus.get(CONTROL_KEY, timeout_s=1.0):
                if not reply.error:
                    self._take(node, reply.payload, live=False)
            await asyncio.sleep(_QUERY_INTERVAL_S)

    async def _judge(self, node: Node, clock_ready: asyncio.Event) -> None:
        """Take a start that came before rig time was known."""
        await clock_ready.wait()
        try:
            if self.state.judge(node.clock.now_ns()):
                self._log()
        except WireError as error:
            node.refuse(CONTROL_KEY, error)

    def _take(self, node: Node, payload: bytes, *, live: bool) -> None:
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
