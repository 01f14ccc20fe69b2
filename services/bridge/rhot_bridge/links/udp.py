"""Packets by UDP."""

from __future__ import annotations

import asyncio
import errno
import logging
import socket
from collections.abc import Sequence
from typing import Final

from rhot.errors import DeviceError

logger = logging.getLogger(__name__)

_PROBE_NS: Final = 1_000_000_000
"""While nobody listens, one frame is sent in so long a time, to see whether somebody does now."""
_NOBODY: Final = (errno.ECONNREFUSED, errno.EHOSTUNREACH, errno.ENETUNREACH, errno.EHOSTDOWN, errno.ENETDOWN)
MOST_BYTES: Final = 65_507
"""Largest UDP payload over IPv4."""


class UdpLink:
    """Sends to one address.

    The socket is connected, so that the answer "nobody listens on this port" (ICMP), where the other machine gives
    one, comes back as an error of a later call.
    """

    def __init__(self, host: str, port: int) -> None:
        self._host, self._port = host, port
        self._socket: socket.socket | None = None
        self._silent_until_ns = 0
        self._problem = ""
        self._probed = False
        self._refusal = 0

    @property
    def where(self) -> str:
        """Where it leads, for people."""
        return f"UDP to {self._host} port {self._port}"

    @property
    def problem(self) -> str:
        """That nobody receives."""
        return self._problem

    async def open(self) -> None:
        """Open the socket.

        Raises:
            DeviceError: the host has no address.
        """
        loop = asyncio.get_running_loop()
        try:
            found = await loop.getaddrinfo(self._host, self._port, type=socket.SOCK_DGRAM)
        except OSError as error:
            raise self._unreachable(error) from error
        family, kind, protocol, _, address = found[0]
        opened = socket.socket(family, kind, protocol)
        opened.setblocking(False)
        try:
            opened.connect(address)
        except OSError as error:
            opened.close()
            raise self._unreachable(error) from error
        self._socket = opened

    def _unreachable(self, error: OSError) -> DeviceError:
        return DeviceError(f"{self._host} cannot be reached: {error.strerror or error}; check --host")

    def wanted(self, now_ns: int) -> bool:
        """Return whether somebody listens, as far as can be told, or it is time to try again."""
        if self._socket is None:
            return False
        code = self._socket.getsockopt(socket.SOL_SOCKET, socket.SO_ERROR) or self._refusal
        self._refusal = 0
        if code in _NOBODY:
            self._refused(now_ns)
        if now_ns < self._silent_until_ns:
            return False
        if self._problem and self._probed:
            logger.info("somebody receives at %s port %d again", self._host, self._port)
            self._problem, self._probed = "", False
        elif self._problem:
            # Whether the probe is refused shows until the silence ends.
            self._probed, self._silent_until_ns = True, now_ns + _PROBE_NS
        return True

    def _refused(self, now_ns: int) -> None:
        self._probed, self._silent_until_ns = False, now_ns + _PROBE_NS
        if not self._problem:
            self._problem = (
                f"nobody receives at {self._host} port {self._port} (UDP); start that program, or check that it "
                "listens on this port"
            )
            logger.warning("%s; it is tried again once a second", self._problem)

    def send(self, packets: Sequence[bytes]) -> int:
        """Send packets; return how many the system did not take, which are lost."""
        if self._socket is None:
            return 0
        lost = 0
        for packet in packets:
            try:
                self._socket.send(packet)
            except OSError as error:
                lost += 1
                if error.errno in _NOBODY:
                    self._refusal = error.errno
        return lost

    async def close(self) -> None:
        """Close the socket."""
        if self._socket is not None:
            self._socket.close()
            self._socket = None
