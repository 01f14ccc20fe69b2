"""OSC 1.0 packets whose addresses and types never change, at the price of a `struct.pack` each.

python-osc makes each message once, with zeros; what comes later replaces only its floats. Building 35 messages for
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
_CHUNK: Final = 5
"""Messages of a block that stay in one packet: few, so that packets get full."""
_SIZE: Final = struct.Struct(">i")
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
        self._head = element(self.zeros)[: 4 + len(self.zeros) - 4 * floats]
        self._floats = struct.Struct(f">{floats}f")

    def pack(self, *values: float) -> bytes:
        """Return an element of a bundle: the message with its floats."""
        return self._head + self._floats.pack(*values)


class Block:
    """Messages that always go out together: filling them is one assignment of numpy's.

    Everything in OSC lies on multiples of four bytes, and so do the floats.
    """

    def __init__(self, templates: Sequence[Template], floats: int, after: bytes = b"") -> None:
        """Make the messages with zeros in them.

        Args:
            templates: of the messages.
            floats: how many each ends with.
            after: a constant message that follows them.
        """
        self._buffer = bytearray()
        self._cuts: list[tuple[int, int]] = []
        ends: list[int] = []
        for first in range(0, len(templates), _CHUNK):
            begin = len(self._buffer)
            for template in templates[first : first + _CHUNK]:
                self._buffer += element(template.zeros)
                ends.append(len(self._buffer) // 4)
            if first + _CHUNK >= len(templates) and after:
                self._buffer += element(after)
            self._cuts.append((begin, len(self._buffer)))
        self._floats = np.frombuffer(self._buffer, dtype=">f4")
        self._places = np.array(ends)[:, None] + np.arange(-floats, 0)

    def pack(self, values: NDArray[np.float64]) -> list[bytes]:
        """Return elements of a bundle with the floats (messages, floats) of each message."""
        self._floats[self._places] = values
        filled = bytes(self._buffer)
        return [filled[begin:end] for begin, end in self._cuts]


def element(message: bytes) -> bytes:
    """Return a message as an element of a bundle: its size before it."""
    return _SIZE.pack(len(message)) + message


def bundles(elements: Iterable[bytes]) -> list[bytes]:
    """Return elements, or runs of them, as bundles, each small enough for one network frame; order is kept."""
    packets: list[bytes] = []
    parts: list[bytes] = [_BUNDLE]
    size = len(_BUNDLE)
    for each in elements:
        if size + len(each) > MOST_BYTES and len(parts) > 1:
            packets.append(b"".join(parts))
            parts, size = [_BUNDLE], len(_BUNDLE)
        parts.append(each)
        size += len(each)
    if len(parts) > 1:
        packets.append(b"".join(parts))
    return packets
