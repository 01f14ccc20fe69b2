"""OSC 1.0 packets whose addresses and types never change, at the price of a `struct.pack` each.

python-osc makes each message once, with zeros; what comes later replaces only its floats. Building 35 messages anew for
every frame would cost more than everything else together.
"""

from __future__ import annotations

import struct
from collections.abc import Iterable, Sequence
from typing import Final

import numpy as np
from numpy.typing import NDArray
from pythonosc.osc_message_builder import OscMessageBuilder

MOST_BYTES: Final = 1472
"""An Ethernet frame without IPv4's and UDP's headers: nothing is cut into pieces on its way."""
_BUNDLE: Final = b"#bundle\0" + struct.pack(">Q", 1)
"""A bundle's start; the time tag 1 means at once."""


class Template:
    """A message with constant first arguments, strings and ints, and floats after them.

    Attributes:
        zeros: the message with all floats 0.
    """

    def __init__(self, address: str, *fixed: str | int, floats: int) -> None:
        """Make the constant part.

        Args:
            address: of the message.
            fixed: its first arguments.
            floats: how many floats follow, each of type `f`.
        """
        builder = OscMessageBuilder(address)
        for value in fixed:
            builder.add_arg(value, builder.ARG_TYPE_STRING if isinstance(value, str) else builder.ARG_TYPE_INT)
        for _ in range(floats):
            builder.add_arg(0.0, builder.ARG_TYPE_FLOAT)
        self.zeros = builder.build().dgram
        self._head = self.zeros[: len(self.zeros) - 4 * floats]
        self._floats = struct.Struct(f">{floats}f")

    def pack(self, *values: float) -> bytes:
        """Return the message with its floats."""
        return self._head + self._floats.pack(*values)


class Block:
    """Messages that always go out together, as bundles: filling them is one assignment of numpy's.

    Everything in OSC lies on multiples of four bytes, and so do the floats.
    """

    def __init__(self, templates: Sequence[Template], floats: int) -> None:
        """Make the packets with zeros in them.

        Args:
            templates: of the messages.
            floats: how many each ends with.
        """
        self._packets: list[tuple[bytearray, NDArray[np.float32], NDArray[np.intp], slice]] = []
        first = 0
        while first < len(templates):
            packet, ends, last = bytearray(_BUNDLE), list[int](), first
            while last < len(templates):
                zeros = templates[last].zeros
                if ends and len(packet) + 4 + len(zeros) > MOST_BYTES:
                    break
                packet += struct.pack(">i", len(zeros)) + zeros
                ends.append(len(packet) // 4)
                last += 1
            places = np.array(ends)[:, None] + np.arange(-floats, 0)
            self._packets.append((packet, np.frombuffer(packet, dtype=">f4"), places, slice(first, last)))
            first = last

    def pack(self, values: NDArray[np.float64]) -> list[bytes]:
        """Return the packets with the floats (messages, floats) of each message."""
        packets: list[bytes] = []
        for packet, view, places, rows in self._packets:
            view[places] = values[rows]
            packets.append(bytes(packet))
        return packets


def bundles(messages: Iterable[bytes]) -> list[bytes]:
    """Return messages as bundles, each small enough for one network frame; order is kept."""
    packets: list[bytes] = []
    parts: list[bytes] = [_BUNDLE]
    size = len(_BUNDLE)
    for message in messages:
        if size + 4 + len(message) > MOST_BYTES and len(parts) > 1:
            packets.append(b"".join(parts))
            parts, size = [_BUNDLE], len(_BUNDLE)
        parts += (struct.pack(">i", len(message)), message)
        size += 4 + len(message)
    if len(parts) > 1:
        packets.append(b"".join(parts))
    return packets
