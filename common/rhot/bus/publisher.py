"""Publishing one key, with its last value kept for queries."""

from __future__ import annotations

import asyncio
from typing import Generic, TypeVar

import zenoh

from rhot.bus.query import Answer, Request, message_answer
from rhot.errors import BusError
from rhot.messages import Message, encode, encoding_of, with_seq

M = TypeVar("M", bound=Message)


class Publisher(Generic[M]):
    """Publishes messages of one model on one key; made by `Bus.publisher`.

    `put` numbers the messages and is cheap enough for the event loop: with congestion control *drop* it never waits.
    """

    def __init__(self, key: str, model: type[M], publisher: zenoh.Publisher) -> None:
        self.key = key
        self._publisher = publisher
        self._encoding = zenoh.Encoding(encoding_of(model))
        self._seq = 0
        self._last: M | None = None

    @property
    def last(self) -> M | None:
        """The message published last."""
        return self._last

    @property
    def has_reader(self) -> bool:
        """Whether somebody subscribes to the key."""
        # The status object itself is always truthy; its field is what counts.
        return bool(self._publisher.matching_status.matching)  # type: ignore[attr-defined]

    def put(self, message: M, *, answers: bool = True) -> M:
        """Publish a message and return it as sent, with its sequence number.

        Args:
            message: to publish.
            answers: whether it answers queries from now on.

        Raises:
            BusError: the session is closed.
        """
        numbered = with_seq(message, self._seq)
        self._seq += 1
        # Kept before it is sent: who saw the sample and asks at once gets at least this one.
        self._last = numbered if answers else None
        try:
            self._publisher.put(encode(numbered), encoding=self._encoding)
        # RuntimeError: another thread is taking the publisher back.
        except (zenoh.ZError, RuntimeError) as error:
            raise BusError(f"{self.key}: cannot publish: {error}") from error
        return numbered

    def forget(self) -> None:
        """Answer queries no more until the next message: what was published last does not hold any longer."""
        self._last = None

    def answer_last(self, request: Request) -> Answer | None:
        """Answer a query with the last value; nothing before the first."""
        last = self._last
        return None if last is None else message_answer(last, request)

    async def wait_for_reader(self, timeout_s: float) -> bool:
        """Wait until somebody subscribes; return whether somebody did.

        A sample put right after the publisher was declared is lost until the router knows of a subscriber.
        """
        deadline = asyncio.get_running_loop().time() + timeout_s
        while not self.has_reader:
            if asyncio.get_running_loop().time() >= deadline:
                return False
            match_poll_s = 0.005
            await asyncio.sleep(match_poll_s)
        return True
