"""A service whose core is a stage: messages in, messages out."""

from __future__ import annotations

import asyncio
import time
from collections.abc import Callable, Mapping
from typing import Generic, TypeVar

from pydantic import BaseModel

from rhot.bus import LatestSubscriber
from rhot.messages import Control, Message
from rhot.service.node import Node
from rhot.stage import Output, Stage

M = TypeVar("M", bound=Message)
C = TypeVar("C", bound=BaseModel)


class StageService(Generic[M, C]):
    """Feeds the newest sample of each input key to a stage and publishes what comes out.

    Each session gets a fresh stage, so that nothing of an earlier one lives on.
    """

    def __init__(
        self,
        name: str,
        *,
        input_keys: str,
        model: type[M],
        key_of: Callable[[M], str] | None,
        config: C,
        make_stage: Callable[[C], Stage[M, C]],
        instance: str = "main",
        owns_clock: bool = False,
        side_inputs: Mapping[str, type[M]] | None = None,
    ) -> None:
        """Prepare a service.

        Args:
            name, instance: on the bus.
            input_keys: what the stage is fed with.
            model: what stands on them.
            key_of: the only key on which a message may stand; None = any of them.
            config: the first configuration.
            make_stage: makes a stage for a session.
            owns_clock: this machine's clock is the rig clock.
            side_inputs: keys and models of what the stage is handed beside its input.
        """
        self.name = name
        self.instance = instance
        self.owns_clock = owns_clock
        self._input_keys = input_keys
        self._model = model
        self._key_of = key_of
        self._config = config
        self._make_stage = make_stage
        self._stage = make_stage(config)
        self._mailbox: LatestSubscriber | None = None
        self._side_inputs = dict(side_inputs or {})
        self._side_mailboxes: list[tuple[LatestSubscriber, type[M]]] = []

    @property
    def config(self) -> C:
        """The configuration in force."""
        return self._config

    def reconfigure(self, config: BaseModel) -> None:
        """Hand a new configuration to the running stage."""
        if not isinstance(config, type(self._config)):
            raise TypeError(f"{type(config).__name__} is not a {type(self._config).__name__}")
        self._stage.configure(config)
        self._config = config

    def attach(self, node: Node) -> None:
        """Subscribe to the input; publishers follow with their first message."""
        self._mailbox = node.bus.latest(self._input_keys)
        self._side_mailboxes = [(node.bus.latest(keys), model) for keys, model in self._side_inputs.items()]
        node.status.include(self._counts)
        node.status.watch(lambda: (self._stage.figures, self._stage.problem))

    def _counts(self) -> dict[str, int]:
        counts = dict(self._stage.counts)
        if self._mailbox is not None:
            counts["overwritten"] = self._mailbox.overwritten
        return counts

    async def run(self, node: Node, start: Control) -> None:
        """Feed the stage until cancelled."""
        if self._mailbox is None:
            raise RuntimeError("run before attach")
        self._stage = self._make_stage(self._config)
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
            return self._stage.feed(message)
        except (ValueError, ArithmeticError) as error:
            # A sample that the core cannot digest costs that sample and the core's memory, never the service.
            node.failed(error)
            self._stage = self._make_stage(self._config)
            return []
