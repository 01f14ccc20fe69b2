"""Messages to all clients of a WebSocket server."""

from __future__ import annotations

import contextlib
import logging
import re
from collections.abc import Sequence
from typing import Final

from websockets.asyncio.server import Server, ServerConnection, broadcast, serve
from websockets.exceptions import ConnectionClosed
from websockets.typing import Origin

from rhot.errors import DeviceError

logger = logging.getLogger(__name__)

MOST_READERS: Final = 16
"""Largest number of connected clients; chosen."""
_HERE: Final = re.compile(r"https?://(localhost|127\.0\.0\.1|\[::1\])(:\d+)?")
"""Origins on this machine. Programs other than browsers send no origin. Any other web page is refused, because it could
read the poses without the user's knowledge."""


class WebSocketLink:
    """WebSocket server on one port; sends each packet as a text message to every client that keeps up."""

    def __init__(self, host: str, port: int, allow_origins: Sequence[str] = ()) -> None:
        self._host, self._port = host, port
        self._origins = [None, _HERE, *(Origin(each) for each in allow_origins)]
        self._server: Server | None = None
        self._readers: set[ServerConnection] = set()

    @property
    def where(self) -> str:
        """The server's address, for people."""
        return f"WebSocket at ws://{self._host}:{self._port}"

    @property
    def problem(self) -> str:
        """Always empty: a server without clients is not a problem."""
        return ""

    async def open(self) -> None:
        """Start listening.

        Raises:
            DeviceError: the port is in use, or the address is not this machine's.
        """
        # The library logs every failed connection; clients are logged below.
        library = logging.getLogger("rhot_bridge.websockets")
        library.setLevel(logging.ERROR)
        try:
            self._server = await serve(
                self._stay,
                self._host,
                self._port,
                origins=self._origins,
                # Compressing small messages of numbers at 90 Hz costs more time than it saves.
                compression=None,
                max_size=1024,
                close_timeout=0.5,
                logger=library,
            )
        except OSError as error:
            raise DeviceError(
                f"cannot listen on {self._host} port {self._port}: {error.strerror or error}; another program, or "
                "another bridge, has it: choose another --port"
            ) from error

    async def _stay(self, reader: ServerConnection) -> None:
        if len(self._readers) >= MOST_READERS:
            await reader.close(1013, "too many readers")
            return
        self._readers.add(reader)
        logger.info("a reader has connected, %d now", len(self._readers))
        try:
            # A program that crashes, or sends too large a message, ends the connection without a closing handshake.
            with contextlib.suppress(ConnectionClosed):
                async for _ in reader:
                    pass  # Messages from clients are ignored.
        finally:
            self._readers.discard(reader)
            logger.info("a reader has gone, %d left", len(self._readers))

    def wanted(self, now_ns: int) -> bool:
        """Return whether any client is connected."""
        return bool(self._readers)

    def send(self, packets: Sequence[bytes]) -> int:
        """Send messages to all clients that keep up; return how many messages the others missed."""
        # A client with more unsent bytes, about ten messages, is skipped: it misses messages instead of
        # receiving old ones.
        ready = [each for each in self._readers if each.transport.get_write_buffer_size() < 65_536]
        for packet in packets:
            broadcast(ready, packet, text=True)
        return (len(self._readers) - len(ready)) * len(packets)

    async def close(self) -> None:
        """Close all connections and stop listening."""
        if self._server is not None:
            self._server.close()
            await self._server.wait_closed()
            self._server = None
