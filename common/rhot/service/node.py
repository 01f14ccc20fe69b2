"""What a service gets to work with: its bus, the rig clock, its figures."""

from __future__ import annotations

import asyncio
import logging
from collections.abc import AsyncIterator, Callable, Coroutine
from dataclasses import dataclass, field
from typing import Any, Final, TypeVar

from rhot.bus import Bus, EventSubscriber, LatestSubscriber, Publisher, Sample
from rhot.clock import NodeClock, RigClock
from rhot.errors import WireError
from rhot.messages import Message, decode
from rhot.service.status import StatusBoard
from rhot.text import SparingLog

logger = logging.getLogger(__name__)

M = TypeVar("M", bound=Message)

MAX_AGE_NS: Final = 2_000_000_000
MAX_AHEAD_NS: Final = 100_000_000
"""A sample older or newer than this is not of this moment: a clock is wrong, or somebody writes garbage."""


@dataclass(slots=True)
class Node:
    """One running service's connection to the rig.

    Attributes:
        service, instance: its name on the bus.
        bus: the session.
        node_clock: this machine's own clock.
        clock: rig time.
        status: its figures.
    """

    service: str
    instance: str
    bus: Bus
    node_clock: NodeClock
    clock: RigClock
    status: StatusBoard
    _sparing: SparingLog = field(default_factory=SparingLog)
    _publishers: dict[str, Publisher[Message]] = field(default_factory=dict)
    _beside: list[Callable[[], Coroutine[Any, Any, None]]] = field(default_factory=list)

    def beside(self, work: Callable[[], Coroutine[Any, Any, None]]) -> None:
        """Ask, in `Service.attach`, for work that goes on with and without a session until the service ends."""
        self._beside.append(work)

    def start_beside(self, tasks: asyncio.TaskGroup) -> None:
        """Start what was asked for; the runner does this once."""
        for work in self._beside:
            tasks.create_task(work())

    def publish(self, key: str, message: Message) -> None:
        """Publish on a key that appears with its first message, and note how old the message is by then."""
        publisher = self._publishers.get(key)
        if publisher is None:
            model: type[Message] = type(message)
            publisher = self._publishers[key] = self.bus.publisher(key, model)
        publisher.put(message)
        self.status.tick("output")
        self.status.latency("output_age", (self.clock.now_ns() - message.t_ns) / 1e9)

    def has_reader(self, key: str) -> bool:
        """Tell whether somebody subscribes to a key that this service publishes on."""
        publisher = self._publishers.get(key)
        return publisher is not None and publisher.has_reader

    async def receive(
        self,
        mailbox: LatestSubscriber | EventSubscriber,
        model: type[M],
        key_of: Callable[[M], str] | None = None,
    ) -> AsyncIterator[M]:
        """Yield every valid message of this moment; the others are counted and logged sparingly.

        Args:
            mailbox: where samples arrive.
            model: what they must be.
            key_of: the only key on which a message may stand; None = any that the mailbox subscribes to.
        """
        async for sample in mailbox:
            if (message := self.read(sample, model, key_of)) is None:
                continue
            if isinstance(mailbox, LatestSubscriber):
                mailbox.keep_slot_of(sample.key)
            yield message

    def read(self, sample: Sample, model: type[M], key_of: Callable[[M], str] | None = None) -> M | None:
        """Return the message in a sample; None for a deletion and for what is refused, which is counted and logged."""
        if sample.deleted:
            return None
        try:
            message = decode(sample.payload, model)
            self._check_time(message)
            if key_of is not None and key_of(message) != sample.key:
                raise WireError(f"the message belongs on {key_of(message)}")
        except WireError as error:
            self.refuse(sample.key, error)
            return None
        return message

    def refuse(self, key: str, error: WireError) -> None:
        """Count an invalid sample and log it, at most once in five seconds per key."""
        self.status.count("invalid")
        text = f"{key}: {error}"
        self.status.error(text)
        if (quiet := self._sparing.due(key)) is not None:
            logger.warning("invalid sample dropped: %s (%d similar messages suppressed)", text, quiet)

    def failed(self, error: Exception) -> None:
        """Count a sample that the core could not digest, and log why, with a traceback at most once in five seconds."""
        self.status.count("failed")
        self.status.error(f"{self.service}: {type(error).__name__}: {error}")
        if (quiet := self._sparing.due("failed")) is not None:
            logger.error(
                "%s could not process a sample and starts over (%d similar messages suppressed)",
                self.service,
                quiet,
                exc_info=error,
            )

    def _check_time(self, message: Message) -> None:
        if not self.clock.ready:
            return
        age_ns = self.clock.now_ns() - message.t_ns
        if age_ns > MAX_AGE_NS or age_ns < -MAX_AHEAD_NS:
            raise WireError(
                f"t_ns {message.t_ns} is {age_ns / 1e9:.3f} s old; between {-MAX_AHEAD_NS / 1e9:.1f} s and "
                f"{MAX_AGE_NS / 1e9:.0f} s is believed"
            )
