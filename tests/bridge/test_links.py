"""Links: receivers that are there, that are not, that are slow, that have no business here."""

from __future__ import annotations

import asyncio
import contextlib
import logging
import socket
import struct
from collections.abc import Iterator

import pytest
from bus_watch import until
from websockets.asyncio.client import connect
from websockets.exceptions import InvalidStatus
from websockets.typing import Origin

from rhot.errors import DeviceError
from rhot_bridge.links import UdpLink, WebSocketLink
from rhot_bridge.links.websocket import MOST_READERS

SECOND = 1_000_000_000


def connected(link: WebSocketLink) -> int:
    return len(link._readers)


@contextlib.contextmanager
def listening(port: int = 0) -> Iterator[socket.socket]:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as receiver:
        receiver.bind(("127.0.0.1", port))
        receiver.settimeout(5.0)
        yield receiver


async def test_udp_reaches_who_listens() -> None:
    with listening() as receiver:
        link = UdpLink("127.0.0.1", receiver.getsockname()[1])
        assert not link.wanted(0)
        await link.open()
        for number in range(3):
            assert link.wanted(number)
            assert link.send([b"one", b"two"]) == 0
        assert [receiver.recv(100) for _ in range(6)] == [b"one", b"two"] * 3
        assert link.problem == ""
        await link.close()


async def test_udp_without_a_receiver_costs_a_packet_a_second_and_is_told_once(
    free_port: int, caplog: pytest.LogCaptureFixture
) -> None:
    caplog.set_level(logging.INFO)
    link = UdpLink("127.0.0.1", free_port)
    await link.open()
    sent = 0
    for number in range(10 * 90):
        if link.wanted(number * SECOND // 90):
            sent += 1
            link.send([b"x", b"y"])
    assert sent <= 11
    assert "start that program" in link.problem
    assert len(caplog.records) == 1
    with listening(free_port) as receiver:
        sent = 0
        for number in range(10 * 90, 13 * 90):
            if link.wanted(number * SECOND // 90):
                sent += 1
                link.send([b"z"])
        assert receiver.recv(100) == b"z"
        assert sent > 80
        assert link.problem == ""
        assert "somebody receives" in caplog.records[-1].message
    await link.close()


async def test_udp_to_no_machine_says_so() -> None:
    with pytest.raises(DeviceError, match=r"cannot be reached.*--host"):
        await UdpLink("nobody.invalid", 9).open()


async def test_web_socket_reaches_all_readers_and_nobody_costs_nothing(free_port: int) -> None:
    link = WebSocketLink("127.0.0.1", free_port)
    await link.open()
    assert not link.wanted(0)
    url = f"ws://127.0.0.1:{free_port}"
    async with connect(url) as one, connect(url, origin=Origin("http://localhost:8000")) as two:
        await until(lambda: connected(link) == 2)
        assert link.send([b'{"a":1}']) == 0
        assert await one.recv() == await two.recv() == '{"a":1}'
    await until(lambda: connected(link) == 0)
    await link.close()


async def test_web_socket_is_closed_to_other_websites(free_port: int) -> None:
    link = WebSocketLink("127.0.0.1", free_port, ("https://mine.example",))
    await link.open()
    url = f"ws://127.0.0.1:{free_port}"
    for origin in ("https://evil.example", "http://localhost.evil.example", "null"):
        with pytest.raises(InvalidStatus, match="403"):
            async with connect(url, origin=Origin(origin)):
                pass
    async with connect(url, origin=Origin("https://mine.example")):
        await until(lambda: connected(link) == 1)
    await link.close()


async def test_a_reader_that_does_not_read_loses_messages_and_delays_nobody(free_port: int) -> None:
    link = WebSocketLink("127.0.0.1", free_port)
    await link.open()
    url = f"ws://127.0.0.1:{free_port}"
    async with connect(url, max_queue=1) as slow, connect(url) as quick:
        await until(lambda: connected(link) == 2)
        slow.transport.pause_reading()
        lost, seen = 0, 0
        for number in range(2000):
            lost += link.send([b"%08d" % number + b"." * 8000])
            seen = int((await asyncio.wait_for(quick.recv(), 30.0))[:8])
            assert seen == number
        assert lost > 1000
        slow.transport.abort()
    await link.close()


async def test_web_socket_has_room_for_so_many_readers(free_port: int) -> None:
    link = WebSocketLink("127.0.0.1", free_port)
    await link.open()
    async with contextlib.AsyncExitStack() as stack:
        for _ in range(MOST_READERS):
            await stack.enter_async_context(connect(f"ws://127.0.0.1:{free_port}"))
        await until(lambda: connected(link) == MOST_READERS)
        async with connect(f"ws://127.0.0.1:{free_port}") as further:
            await further.wait_closed()
            assert further.close_code == 1013
    await link.close()


@pytest.mark.parametrize("how", ["reset", "too large a message"])
async def test_a_reader_that_breaks_off_leaves_no_traceback(
    free_port: int, caplog: pytest.LogCaptureFixture, how: str
) -> None:
    link = WebSocketLink("127.0.0.1", free_port)
    await link.open()
    reader = await connect(f"ws://127.0.0.1:{free_port}")
    await until(lambda: connected(link) == 1)
    if how == "reset":
        # Without lingering, closing the socket sends a TCP reset, as the system does for a program that crashed.
        sock = reader.transport.get_extra_info("socket")
        sock.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))
        reader.transport.abort()
    else:
        await reader.send("x" * 5000)
        await reader.wait_closed()
    await until(lambda: connected(link) == 0)
    await link.close()
    assert [record for record in caplog.records if record.levelno >= logging.ERROR] == []


async def test_a_host_name_that_cannot_be_one_is_refused_in_words() -> None:
    with pytest.raises(DeviceError, match=r"cannot be reached.*--host"):
        await UdpLink("a" * 64, 9).open()


async def test_a_busy_port_says_so(free_port: int) -> None:
    first, second = WebSocketLink("127.0.0.1", free_port), WebSocketLink("127.0.0.1", free_port)
    await first.open()
    with pytest.raises(DeviceError, match=r"another program.*--port"):
        await second.open()
    await first.close()
    await second.close()
