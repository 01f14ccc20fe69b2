"""Links that send packets to another program without blocking; a missing receiver is logged once and costs no work."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Protocol

from rhot_bridge.links.udp import UdpLink
from rhot_bridge.links.websocket import WebSocketLink

__all__ = ["Link", "UdpLink", "WebSocketLink"]


class Link(Protocol):
    """A connection to a receiver."""

    @property
    def where(self) -> str:
        """Its address, for people."""
        ...

    @property
    def problem(self) -> str:
        """Why packets do not arrive, one sentence; empty while they do, as far as is known."""
        ...

    async def open(self) -> None:
        """Open the link.

        Raises:
            DeviceError: it cannot be opened; the service runner tries again.
        """
        ...

    def wanted(self, now_ns: int) -> bool:
        """Return whether packets would be sent now; `now_ns` is on the monotonic clock."""
        ...

    def send(self, packets: Sequence[bytes]) -> int:
        """Send packets and return how many were lost on this machine."""
        ...

    async def close(self) -> None:
        """Close the link; closing it twice does no harm."""
        ...
