"""The link that misbehaves does so as a lossy network below TCP would."""

from __future__ import annotations

import asyncio
import contextlib
from collections.abc import AsyncIterator

from bad_link import Link, relay


@contextlib.asynccontextmanager
async def through(link: Link) -> AsyncIterator[tuple[asyncio.StreamWriter, list[tuple[float, bytes]]]]:
    """Give a sender, and what arrives at the other end of a link with the times."""
    arrived: list[tuple[float, bytes]] = []
    loop = asyncio.get_running_loop()

    async def receive(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        while data := await reader.read(1 << 16):
            arrived.append((loop.time(), data))
        writer.close()

    server = await asyncio.start_server(receive, "127.0.0.1", 0)
    target = f"tcp/127.0.0.1:{server.sockets[0].getsockname()[1]}"
    async with server, relay(target, link) as endpoint:
        _, writer = await asyncio.open_connection("127.0.0.1", int(endpoint.rpartition(":")[2]))
        yield writer, arrived
        writer.close()


async def until_there(arrived: list[tuple[float, bytes]], size: int) -> None:
    async with asyncio.timeout(20.0):
        while sum(len(data) for _, data in arrived) < size:
            await asyncio.sleep(0.005)


async def send(writer: asyncio.StreamWriter, number: int) -> None:
    for value in range(number):
        writer.write(bytes([value]))
        await asyncio.sleep(0.01)


async def test_what_waits_behind_a_lost_segment_comes_at_once_and_in_order() -> None:
    link = Link(stall_share=1.0, stall_s=0.2)
    async with through(link) as (writer, arrived):
        writer.write(b"\0")
        await asyncio.sleep(0.02)
        link.stall_share = 0.0
        begun_s = asyncio.get_running_loop().time()
        for value in range(1, 10):
            writer.write(bytes([value]))
            await asyncio.sleep(0.005)
        await until_there(arrived, 10)
    assert b"".join(data for _, data in arrived) == bytes(range(10))
    assert min(at_s for at_s, _ in arrived) > begun_s + 0.15
    assert link.stalls == 1


async def test_delay_and_jitter_never_change_the_order() -> None:
    async with through(Link(delay_s=0.02, jitter_s=0.015)) as (writer, arrived):
        begun_s = asyncio.get_running_loop().time()
        await send(writer, 30)
        await until_there(arrived, 30)
    assert b"".join(data for _, data in arrived) == bytes(range(30))
    assert arrived[0][0] >= begun_s + 0.005


async def test_a_cut_holds_everything_until_a_repetition_after_its_end() -> None:
    link = Link()
    async with through(link) as (writer, arrived):
        await send(writer, 3)
        await until_there(arrived, 3)
        link.cut()
        await send(writer, 3)
        await asyncio.sleep(0.3)
        assert sum(len(data) for _, data in arrived) == 3
        mended_s = asyncio.get_running_loop().time()
        link.mend()
        await until_there(arrived, 6)
    # Sent at 0, repeated at 0.2 and 0.6; mended at about 0.33.
    assert arrived[-1][0] > mended_s + 0.15


async def test_a_slow_link_carries_what_it_says() -> None:
    async with through(Link(bytes_per_s=100_000.0)) as (writer, arrived):
        begun_s = asyncio.get_running_loop().time()
        writer.write(bytes(30_000))
        await until_there(arrived, 30_000)
    assert arrived[-1][0] - begun_s >= 0.29
