"""Receiving samples on the event loop: newest-wins slots and bounded queues of events.

Zenoh calls back on its own threads. The callback copies the payload and leaves; the loop is woken only when nothing
is pending, so that a burst costs one wake-up.
"""

from __future__ import annotations

import asyncio
import threading
import time
from abc import ABC, abstractmethod
from collections import deque
from collections.abc import AsyncIterator
from dataclasses import dataclass
from typing import TypeVar

import zenoh

from rhot.bus.zenoh_config import (
    MAX_FOREIGN_KEYS,
    MAX_KNOWN_KEYS,
    MAX_SAMPLE_BYTES,
    MAX_UNREAD_BYTES,
    LimitCounts,
)
from rhot.errors import BusError, WireError
from rhot.messages import Message, decode
from rhot.text import printable

M = TypeVar("M", bound=Message)


@dataclass(frozen=True, slots=True)
class Sample:
    """One received sample.

    Attributes:
        key: its key, without the namespace, printable.
        payload: bytes as sent; empty for a deletion.
        encoding: Zenoh encoding.
        deleted: the key was deleted (for liveliness: the service is gone).
        arrived_ns: `time.monotonic_ns` on arrival.
    """

    key: str
    payload: bytes
    encoding: str
    deleted: bool
    arrived_ns: int


class _Mailbox(ABC):
    """What both kinds of subscriber share: waking the event loop, counting, ending."""

    def __init__(self, limits: LimitCounts | None = None) -> None:
        self._limits = limits or LimitCounts()
        self._loop = asyncio.get_running_loop()
        self._wake = asyncio.Event()
        self._lock = threading.Lock()
        self._pending = False
        self._closed = False
        self.received = 0
        self.overwritten = 0

    def close(self) -> None:
        """End the iteration; what arrives later is ignored."""
        with self._lock:
            # Zenoh may still deliver what it had queued when the subscriber was undeclared.
            self._closed = True
        self._signal()

    def clear(self) -> None:
        """Forget what has not been read yet."""
        with self._lock:
            self._drain()

    def __call__(self, zenoh_sample: zenoh.Sample) -> None:
        """Take one sample, on Zenoh's thread."""
        if len(zenoh_sample.payload) > MAX_SAMPLE_BYTES:
            self._limits.hit("oversized")
            return
        sample = Sample(
            key=printable(str(zenoh_sample.key_expr)),
            payload=zenoh_sample.payload.to_bytes(),
            encoding=printable(str(zenoh_sample.encoding)),
            deleted=zenoh_sample.kind == zenoh.SampleKind.DELETE,
            arrived_ns=time.monotonic_ns(),
        )
        with self._lock:
            if self._closed:
                return
            self.received += 1
            self._store(sample)
            if self._pending:
                return
            self._pending = True
        self._signal()

    def _signal(self) -> None:
        try:
            self._loop.call_soon_threadsafe(self._wake.set)
        except RuntimeError:
            # The loop is closed: the process is ending and nobody reads any more.
            self._closed = True

    @abstractmethod
    def _store(self, sample: Sample) -> None:
        """Keep a sample; the lock is held."""

    @abstractmethod
    def _drain(self) -> list[Sample]:
        """Return what was kept, in the order of reading, and forget it; the lock is held."""

    async def next(self) -> Sample:
        """Return the next sample.

        Raises:
            BusError: the mailbox was closed.
        """
        async for sample in self:
            return sample
        raise BusError("the session was closed while a sample was waited for")

    async def __aiter__(self) -> AsyncIterator[Sample]:
        """Yield samples as they come, until closed."""
        while True:
            await self._wake.wait()
            self._wake.clear()
            with self._lock:
                samples = self._drain()
                self._pending = False
                closed = self._closed
            for sample in samples:
                yield sample
            if closed:
                return

    async def messages(self, model: type[M]) -> AsyncIterator[tuple[Sample, M]]:
        """Yield samples with the messages in them; deletions and what is no valid `model` are skipped.

        For tools; `rhot.service.Node.receive` also counts and logs what it refuses.
        """
        async for sample in self:
            if sample.deleted:
                continue
            try:
                message = decode(sample.payload, model)
            except WireError:
                continue
            yield sample, message


class LatestSubscriber(_Mailbox):
    """Keeps the newest sample of each key: a slow reader loses old ones and never sees late ones.

    The number of slots is bounded. Keys that have brought something valid keep theirs; the others, which anybody may
    make up, share a few, and the oldest of them goes.

    Attributes:
        received: samples that arrived.
        overwritten: samples that a newer one replaced before they were read.
    """

    def __init__(self, limits: LimitCounts | None = None) -> None:
        super().__init__(limits)
        self._known: set[str] = set()
        self._slots: dict[str, Sample] = {}
        self._foreign: dict[str, Sample] = {}

    def keep_slot_of(self, key: str) -> None:
        """Say that a key has brought something valid: strangers' keys no longer push it out."""
        if key not in self._known and len(self._known) < MAX_KNOWN_KEYS:
            with self._lock:
                self._known.add(key)

    def _store(self, sample: Sample) -> None:
        # Taken out first, so that keys are read in the order of their newest arrival.
        if self._slots.pop(sample.key, None) or self._foreign.pop(sample.key, None):
            self.overwritten += 1
        if sample.key in self._known:
            self._slots[sample.key] = sample
            return
        if len(self._foreign) >= MAX_FOREIGN_KEYS:
            del self._foreign[next(iter(self._foreign))]
            self._limits.hit("foreign_keys_dropped")
        self._foreign[sample.key] = sample

    def _drain(self) -> list[Sample]:
        samples = [*self._slots.values(), *self._foreign.values()]
        self._slots.clear()
        self._foreign.clear()
        return samples


class EventSubscriber(_Mailbox):
    """Keeps every sample up to a limit of number and bytes, for what must not be lost; beyond it the oldest go.

    Attributes:
        received: samples that arrived.
        overwritten: samples lost because the reader was too slow.
    """

    def __init__(self, limit: int, limits: LimitCounts | None = None) -> None:
        super().__init__(limits)
        self._limit = limit
        self._queue: deque[Sample] = deque()
        self._bytes = 0

    def _store(self, sample: Sample) -> None:
        self._queue.append(sample)
        self._bytes += len(sample.payload)
        while len(self._queue) > self._limit or self._bytes > MAX_UNREAD_BYTES:
            self._bytes -= len(self._queue.popleft().payload)
            self.overwritten += 1
            self._limits.hit("unread_dropped")

    def _drain(self) -> list[Sample]:
        samples = list(self._queue)
        self._queue.clear()
        self._bytes = 0
        return samples
