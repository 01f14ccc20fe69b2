"""Messages to all who connect by WebSocket."""

from __future__ import annotations

import logging
import re
from collections.abc import Sequence
from typing import Final

from websockets.asyncio.server import Server, ServerConnection, broadcast, serve
from websockets.typing import Origin

from rhot.errors import DeviceError

logger = logging.getLogger(__name__)

MOST_READERS: Final = 16
"""Programs and pages that may read at once; chosen."""
_MOST_UNSENT_BYTES: Final = 65_536
"""A reader with more than about ten messages unread is slow: it misses messages instead of getting old ones."""
_HERE: Final = re.compile(r"https?://(localhost|127\.0\.0\.1|\[::1\])(:\d+)?")
"""Pages of this machine. Programs that are no browsers say no origin; any other page could read along unseen."""


class WebSocketLink:
    """Listens on one port; one text message a packet, the newest to everybody who keeps up."""

    def __init__(self, host: str, port: int, allow_origins: Sequence[str] = ()) -> None:
        self._host, self._port = host, port
        self._origins = [None, _HERE, *(Origin(each) for each in allow_origins)]
        self._server: Server | None = None
        self._readers: set[ServerConnection] = set()

    @property
    def where(self) -> str:
        """Where it leads, for people."""
        return f"WebSocket at ws://{self._host}:{self._port}"

    @property
    def problem(self) -> str:
        """Nothing: that nobody has connected yet is none."""
        return ""

    @property
    def readers(self) -> int:
        """How many are connected."""
        return len(self._readers)

    async def open(self) -> None:
        """Listen.

        Raises:
            DeviceError: the port or the address cannot be had.
        """
        # It logs every connection that fails; who reads is told here.
        library = logging.getLogger("rhot_bridge.websockets")
        library.setLevel(logging.ERROR)
        try:
            self._server = await serve(
                self._stay,
                self._host,
                self._port,
                origins=self._origins,
                # Small messages of numbers at 90 Hz: packing them costs more than it saves.
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
            async for _ in reader:
                pass  # Nothing is expected of a reader.
        finally:
            self._readers.discard(reader)
            logger.info("a reader has gone, %d left", len(self._readers))

    def wanted(self, now_ns: int) -> bool:
        """Return whether anybody is connected."""
        return bool(self._readers)

    def send(self, packets: Sequence[bytes]) -> int:
        """Send messages to all who keep up; return how many others missed."""
        ready = [each for each in self._readers if each.transport.get_write_buffer_size() < _MOST_UNSENT_BYTES]
        for packet in packets:
            broadcast(ready, packet, text=True)
        return (len(self._readers) - len(ready)) * len(packets)

    async def close(self) -> None:
        """Say goodbye to all and stop listening."""
        if self._server is not None:
            self._server.close()
            await self._server.wait_closed()
            self._server = None
