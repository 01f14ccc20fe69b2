"""Counting what was recorded and what was lost on the way, from the sequence numbers that publishers give."""

from __future__ import annotations

from dataclasses import dataclass, field

import msgpack


@dataclass(slots=True)
class KeyCount:
    """What arrived on one key.

    Attributes:
        messages: samples that arrived.
        bytes: sum of their payloads.
        lost: sequence numbers that were skipped.
        restarts: how often the numbers began again, because the publisher did.
    """

    messages: int = 0
    bytes: int = 0
    lost: int = 0
    restarts: int = 0
    _last_seq: int | None = None

    def note(self, seq: int | None, size: int) -> None:
        """Count one sample of `size` bytes; `seq` is None where the payload carries no number."""
        self.messages += 1
        self.bytes += size
        if seq is None:
            return
        if self._last_seq is not None:
            if seq > self._last_seq:
                self.lost += seq - self._last_seq - 1
            else:
                self.restarts += 1
        self._last_seq = seq


@dataclass(slots=True)
class Tally:
    """Counts by key.

    Attributes:
        keys: in the order of their first sample.
    """

    keys: dict[str, KeyCount] = field(default_factory=dict)

    def note(self, key: str, seq: int | None, size: int) -> None:
        """Count one sample."""
        count = self.keys.get(key)
        if count is None:
            count = self.keys[key] = KeyCount()
        count.note(seq, size)

    @property
    def messages(self) -> int:
        """Samples on all keys."""
        return sum(count.messages for count in self.keys.values())

    @property
    def lost(self) -> int:
        """Skipped numbers on all keys."""
        return sum(count.lost for count in self.keys.values())


def peek(payload: bytes) -> tuple[int | None, int | None]:
    """Return `t_ns` and `seq` of a msgpack message without decoding the rest; None for what it does not carry.

    The models put both first, so that this costs some microseconds however large the message is.
    """
    found: dict[str, int] = {}
    unpacker = msgpack.Unpacker(strict_map_key=False)
    try:
        unpacker.feed(payload)
        for _ in range(unpacker.read_map_header()):
            name = unpacker.unpack()
            if name not in ("t_ns", "seq"):
                unpacker.skip()
                continue
            value = unpacker.unpack()
            if isinstance(value, int) and not isinstance(value, bool) and 0 <= value < 1 << 63:
                found[name] = value
            if len(found) == 2:
                break
    except (ValueError, TypeError, RecursionError, msgpack.UnpackException):
        # Recorded as it is all the same: what is wrong on the bus is worth seeing later.
        pass
    return found.get("t_ns"), found.get("seq")
