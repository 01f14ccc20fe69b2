"""A service around a core: messages in, messages out."""

from __future__ import annotations

import asyncio
import time
from collections.abc import Callable, Mapping
from typing import Generic, TypeVar

from pydantic import BaseModel

from rhot.bus import LatestSubscriber
from rhot.core import Core, Output
from rhot.messages import Control, Message
from rhot.service.node import Node

M = TypeVar("M", bound=Message)
C = TypeVar("C", bound=BaseModel)


class CoreService(Generic[M, C]):
    """Feeds the newest sample of each input key to a core and publishes what comes out.

    Each session gets a fresh core, so that nothing of an earlier one lives on.
    """

    def __init__(
        self,
        name: str,
        *,
        input_keys: str,
        model: type[M],
        key_of: Callable[[M], str] | None,
        config: C,
        make_core: Callable[[C], Core[M, C]],
        instance: str = "main",
        owns_clock: bool = False,
        side_inputs: Mapping[str, type[M]] | None = None,
    ) -> None:
        """Prepare a service.

        Args:
            name, instance: on the bus.
            input_keys: what the core is fed with.
            model: what stands on them.
            key_of: the only key on which a message may stand; None = any of them.
            config: the first configuration.
            make_core: makes a core for a session.
            owns_clock: this machine's clock is the rig clock.
            side_inputs: keys and models of what the core is handed beside its input.
        """
        self.name = name
        self.instance = instance
        self.owns_clock = owns_clock
        self._input_keys = input_keys
        self._model = model
        self._key_of = key_of
        self._config = config
        self._make_core = make_core
        self._core = make_core(config)
        self._mailbox: LatestSubscriber | None = None
        self._side_inputs = dict(side_inputs or {})
        self._side_mailboxes: list[tuple[LatestSubscriber, type[M]]] = []

    @property
    def config(self) -> C:
        """The configuration in force."""
        return self._config

    def reconfigure(self, config: BaseModel) -> None:
        """Hand a new configuration to the running core."""
        if not isinstance(config, type(self._config)):
            raise TypeError(f"{type(config).__name__} is not a {type(self._config).__name__}")
        self._core.configure(config)
        self._config = config

    def attach(self, node: Node) -> None:
        """Subscribe to the input; publishers follow with their first message."""
        self._mailbox = node.bus.latest(self._input_keys)
        self._side_mailboxes = [(node.bus.latest(keys), model) for keys, model in self._side_inputs.items()]
        node.status.include(self._counts)
        node.status.watch(lambda: (self._core.figures, self._core.problem))

    def _counts(self) -> dict[str, int]:
        counts = dict(self._core.counts)
        if self._mailbox is not None:
            counts["overwritten"] = self._mailbox.overwritten
        return counts

    async def run(self, node: Node, start: Control) -> None:
        """Feed the core until cancelled."""
        if self._mailbox is None:
            raise RuntimeError("run before attach")
        self._core = self._make_core(self._config)
        self._mailbox.clear()
        async with asyncio.TaskGroup() as tasks:
            for side_mailbox, model in self._side_mailboxes:
                side_mailbox.clear()
                tasks.create_task(self._listen(node, side_mailbox, model))
            await self._work(node, self._mailbox)

    async def _work(self, node: Node, mailbox: LatestSubscriber) -> None:
        status, clock = node.status, node.clock
        async for message in node.receive(mailbox, self._model, self._key_of):
            status.tick("input")
            begun = time.perf_counter()
            status.latency("input_age", (clock.now_ns() - message.t_ns) / 1e9)
            outputs = self._digest(node, message)
            status.latency("compute", time.perf_counter() - begun)
            for key, output in outputs:
                node.publish(key, output)

    async def _listen(self, node: Node, mailbox: LatestSubscriber, model: type[M]) -> None:
        async for message in node.receive(mailbox, model):
            for key, output in self._digest(node, message):
                node.publish(key, output)

    def _digest(self, node: Node, message: M) -> list[Output]:
        try:
            return self._core.feed(message)
        except (ValueError, ArithmeticError) as error:
            # A sample that the core cannot digest costs that sample and the core's memory, never the service.
            node.failed(error)
            self._core = self._make_core(self._config)
            return []
