"""How packets reach another program; none blocks, and a receiver that is not there costs nothing and is told once."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Protocol

from rhot_bridge.links.udp import UdpLink
from rhot_bridge.links.websocket import WebSocketLink

__all__ = ["Link", "UdpLink", "WebSocketLink"]


class Link(Protocol):
    """A way to a receiver."""

    @property
    def where(self) -> str:
        """Where it leads, for people."""
        ...

    @property
    def problem(self) -> str:
        """Why nothing gets there, one sentence; empty when it does, as far as can be told."""
        ...

    async def open(self) -> None:
        """Open it; a DeviceError is tried again by the runner."""
        ...

    def wanted(self, now_ns: int) -> bool:
        """Return whether it is worth making packets now, by the monotonic clock."""
        ...

    def send(self, packets: Sequence[bytes]) -> int:
        """Send packets and return how many were lost on this machine."""
        ...

    async def close(self) -> None:
        """Close it."""
        ...
