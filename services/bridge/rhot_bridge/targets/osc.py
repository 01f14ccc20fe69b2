"""OSC 1.0 packets with constant addresses and types, each encoded by one `struct.pack`.

python-osc encodes each message once, with zeros; later frames replace only its floats. Encoding 35 messages anew for
each frame would take more time than everything else.
"""

from __future__ import annotations

import struct
from collections.abc import Iterable, Sequence
from typing import Final

import numpy as np
from numpy.typing import NDArray
from pythonosc.osc_message_builder import OscMessageBuilder

MOST_BYTES: Final = 1472
"""Payload of an Ethernet frame without the headers of IPv4 and UDP, so that packets are not fragmented."""
_CHUNK: Final = 5
"""Messages of a block that are not split across packets: few, so that packets are filled well."""
_SIZE: Final = struct.Struct(">i")
_BUNDLE: Final = b"#bundle\0" + struct.pack(">Q", 1)
"""Start of a bundle; the time tag 1 means "immediately"."""


class Template:
    """A message with constant strings and ints, followed by floats.

    Attributes:
        zeros: the encoded message with all floats 0.
    """

    def __init__(self, address: str, *fixed: str | int, floats: int) -> None:
        """Encode the constant part.

        Args:
            address: of the message.
            fixed: its first arguments.
            floats: number of arguments of type `f` that follow.
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
        """Return the message with these floats as an element of a bundle."""
        return self._head + self._floats.pack(*values)


class Block:
    """Messages that are always sent together; one numpy assignment fills in all floats.

    OSC aligns all data to four bytes, including the floats.
    """

    def __init__(self, templates: Sequence[Template], floats: int, after: bytes = b"") -> None:
        """Encode the messages with zeros.

        Args:
            templates: the messages.
            floats: number of floats at the end of each.
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
        """Return the messages with these floats (messages, floats) as elements of a bundle."""
        self._floats[self._places] = values
        filled = bytes(self._buffer)
        return [filled[begin:end] for begin, end in self._cuts]


def element(message: bytes) -> bytes:
    """Return a message as an element of a bundle, prefixed by its size."""
    return _SIZE.pack(len(message)) + message


def bundles(elements: Iterable[bytes]) -> list[bytes]:
    """Return elements, or runs of them, packed in order into bundles of at most one network frame each."""
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
