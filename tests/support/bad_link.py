"""A network link that misbehaves: a TCP relay between a service and its router.

It does to a byte stream what a lossy network does, seen through TCP:

- A segment takes `delay_s` ± `jitter_s`, and never overtakes the one before it (RFC 9293 section 3.4: in order).
- A lost segment comes `stall_s` later, and all that was sent behind it waits and then arrives at once (head-of-line
  blocking). Linux repeats a lost segment after 200 ms at the earliest (TCP_RTO_MIN).
- While the link is cut nothing arrives, and neither side is told. The oldest segment is repeated after 0.2, 0.6, 1.4,
  3, 6.2, … s, doubling (RFC 6298 section 5.5): so long after the cut may it take until the stream goes on. A connection
  that is begun during the cut repeats its SYN after 1, 3, 7, 15 s (tcp_syn_retries in ip-sysctl.rst), and comes about
  then, unless its side gives up sooner.
- A slow link carries `bytes_per_s`.
"""

from __future__ import annotations

import asyncio
import contextlib
import random
from collections.abc import AsyncIterator
from dataclasses import dataclass, field

FIRST_REPEAT_S = 0.2
FIRST_SYN_REPEAT_S = 1.0
MOST_WAITING = 4 << 20
"""Bytes that a sender's kernel keeps (the default maximum of tcp_wmem)."""
SEGMENT = 64 << 10


@dataclass(slots=True)
class Link:
    """What a link is like; may be changed while it runs.

    Attributes:
        delay_s, jitter_s: of a segment, one way; the jitter is even within ±.
        stall_share: of the segments that are lost once.
        stall_s: what that costs.
        bytes_per_s: None = as fast as the machine.
        stalls: segments lost so far.
    """

    delay_s: float = 0.0
    jitter_s: float = 0.0
    stall_share: float = 0.0
    stall_s: float = 0.2
    bytes_per_s: float | None = None
    seed: int = 0
    stalls: int = 0
    _whole: asyncio.Event = field(default_factory=asyncio.Event)
    _random: random.Random = field(init=False)

    def __post_init__(self) -> None:
        self._random = random.Random(self.seed)
        self._whole.set()

    def cut(self) -> None:
        """Let nothing through, and tell nobody."""
        self._whole.clear()

    def mend(self) -> None:
        """End the cut."""
        self._whole.set()

    def due_s(self, now_s: float, size: int, before_s: float) -> float:
        """Return when a segment arrives that is sent now, behind one that arrives at `before_s`."""
        due_s = now_s + self.delay_s + self._random.uniform(-self.jitter_s, self.jitter_s)
        if self._random.random() < self.stall_share:
            self.stalls += 1
            due_s += self.stall_s
        due_s = max(due_s, before_s)
        return due_s if self.bytes_per_s is None else due_s + size / self.bytes_per_s

    async def through(self, first_repeat_s: float) -> None:
        """Wait until what is sent now gets through: at once, or at the first repetition after the cut."""
        if self._whole.is_set():
            return
        loop = asyncio.get_running_loop()
        sent_s, interval_s, passed_s = loop.time(), first_repeat_s, first_repeat_s
        while not self._whole.is_set():
            await self._whole.wait()
            while sent_s + passed_s < loop.time():
                interval_s *= 2.0
                passed_s += interval_s
            await asyncio.sleep(sent_s + passed_s - loop.time())


class _Direction:
    """One half of a connection: reads, keeps each segment as long as the link takes, writes."""

    def __init__(self, link: Link, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        self._link = link
        self._reader = reader
        self._writer = writer
        self._waiting: asyncio.Queue[tuple[float, bytes]] = asyncio.Queue()
        self._room = asyncio.Event()
        self._bytes = 0

    async def run(self) -> None:
        async with asyncio.TaskGroup() as tasks:
            tasks.create_task(self._read())
            tasks.create_task(self._write())

    async def _read(self) -> None:
        loop = asyncio.get_running_loop()
        due_s = 0.0
        while True:
            data = b""  # a connection that is reset ends, too
            with contextlib.suppress(OSError):
                data = await self._reader.read(SEGMENT)
            due_s = self._link.due_s(loop.time(), len(data), due_s)
            self._bytes += len(data)
            self._waiting.put_nowait((due_s, data))
            if not data:
                return
            while self._bytes > MOST_WAITING:
                self._room.clear()
                await self._room.wait()

    async def _write(self) -> None:
        loop = asyncio.get_running_loop()
        with contextlib.suppress(OSError):
            while True:
                due_s, data = await self._waiting.get()
                await asyncio.sleep(max(0.0, due_s - loop.time()))
                await self._link.through(FIRST_REPEAT_S)
                if not data:
                    break
                self._writer.write(data)
                await self._writer.drain()
                self._bytes -= len(data)
                self._room.set()
        self._writer.close()


@contextlib.asynccontextmanager
async def relay(target: str, link: Link) -> AsyncIterator[str]:
    """Give an endpoint (`tcp/127.0.0.1:PORT`) that leads to another one over a link."""
    host, _, port = target.removeprefix("tcp/").rpartition(":")
    connections: set[asyncio.Task[None]] = set()

    async def connect(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        task = asyncio.current_task()
        assert task is not None
        connections.add(task)
        try:
            await link.through(FIRST_SYN_REPEAT_S)
            far_reader, far_writer = await asyncio.open_connection(host, int(port))
            try:
                async with asyncio.TaskGroup() as tasks:
                    tasks.create_task(_Direction(link, reader, far_writer).run())
                    tasks.create_task(_Direction(link, far_reader, writer).run())
            finally:
                far_writer.close()
        except OSError:
            pass  # nobody listens there now: the connection is refused
        except asyncio.CancelledError:
            pass  # the relay ends; asyncio's server would log the cancellation of its own task
        finally:
            connections.discard(task)
            writer.close()

    server = await asyncio.start_server(connect, "127.0.0.1", 0)
    try:
        yield f"tcp/127.0.0.1:{server.sockets[0].getsockname()[1]}"
    finally:
        server.close()
        for task in connections:
            task.cancel()
        await asyncio.gather(*connections, return_exceptions=True)
