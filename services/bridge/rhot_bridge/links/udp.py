"""Packets over UDP."""

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
"""Interval at which one frame is sent as a probe while no program listens."""
_NOBODY: Final = (errno.ECONNREFUSED, errno.EHOSTUNREACH, errno.ENETUNREACH, errno.EHOSTDOWN, errno.ENETDOWN)
MOST_BYTES: Final = 65_507
"""Largest UDP payload over IPv4."""


class UdpLink:
    """Sends to one address.

    The socket is connected, so that an ICMP "port unreachable" from the other machine is reported as an error of a
    later call.
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
        """The receiver's address, for people."""
        return f"UDP to {self._host} port {self._port}"

    @property
    def problem(self) -> str:
        """That no program receives; empty while one does, as far as is known."""
        return self._problem

    async def open(self) -> None:
        """Open the socket.

        Raises:
            DeviceError: the host has no address, or none that this machine can send to.
        """
        loop = asyncio.get_running_loop()
        try:
            found = await loop.getaddrinfo(self._host, self._port, type=socket.SOCK_DGRAM)
            family, kind, protocol, _, address = found[0]
            opened = socket.socket(family, kind, protocol)
        except (OSError, UnicodeError) as error:  # UnicodeError: not a valid host name
            raise self._unreachable(error) from error
        opened.setblocking(False)
        try:
            opened.connect(address)
        except OSError as error:
            opened.close()
            raise self._unreachable(error) from error
        self._socket = opened

    def _unreachable(self, error: Exception) -> DeviceError:
        return DeviceError(f"{self._host} cannot be reached: {getattr(error, 'strerror', None) or error}; check --host")

    def wanted(self, now_ns: int) -> bool:
        """Return whether a program listens, as far as is known, or a probe is due."""
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
            # The refusal of the probe, if any, arrives before the next probe is due.
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
        """Send packets; return how many the system refused, which are lost."""
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
