"""Counting what was recorded and what was lost on the way, from the sequence numbers that publishers give."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, field
from typing import Final

import msgpack

MOST_KINDS: Final = 64
MOST_KEYS_OF_A_KIND: Final = 256
MOST_ENCODINGS_OF_A_KEY: Final = 3
"""Bounds of one recording, a multiple of what a rig has: ten kinds (second chunks of keys), as many keys of a kind as
it has cameras or objects, one encoding. MCAP counts channels in 16 bits, 65,535 at most, and whoever reaches the bus
may invent keys; those of one kind shut out no others."""


@dataclass(frozen=True, slots=True)
class _Numbers:
    """The last number of one publisher, and how many messages its key had brought by then."""

    seq: int
    at: int


@dataclass(slots=True)
class KeyCount:
    """What arrived on one key.

    Attributes:
        messages: samples that arrived.
        bytes: sum of their payloads.
        lost: sequence numbers that were skipped.
        restarts: how often the numbers began again, because the publisher did.
        turns: how often two publishers with numbers of their own took turns.
        left_out: arrived and were not recorded.
    """

    messages: int = 0
    bytes: int = 0
    lost: int = 0
    restarts: int = 0
    turns: int = 0
    left_out: int = 0
    _publishers: list[_Numbers] = field(default_factory=list)

    @property
    def shared(self) -> bool:
        """Whether two publishers sent at once; one that was started again takes its turn once."""
        fewest_turns = 4
        return self.turns >= fewest_turns

    def note(self, seq: int | None, size: int) -> None:
        """Count one sample of `size` bytes; `seq` is None where the payload carries no number."""
        self.messages += 1
        self.bytes += size
        if seq is None:
            return
        # The newest first. One that was started again soon sends no more, and is forgotten.
        # Messages of others on its key after which a publisher counts as gone. Chosen.
        known = [each for each in self._publishers if self.messages - each.at <= 32]
        # Numbers skipped at once: more than an hour at 240 a second is another publisher with numbers of its
        # own.
        sender = max(
            (each for each in known if 0 < seq - each.seq <= 1_000_000), key=lambda each: each.seq, default=None
        )
        if sender is None:
            self.restarts += bool(self._publishers)
        else:
            self.lost += seq - sender.seq - 1
            self.turns += sender is not self._publishers[0]
            known.remove(sender)
        self._publishers = [_Numbers(seq, self.messages), *known[:1]]


@dataclass(slots=True)
class Tally:
    """Counts by key.

    Attributes:
        keys: in the order of their first sample.
        left_out: samples that were not recorded because there were too many keys already.
    """

    keys: dict[str, KeyCount] = field(default_factory=dict)
    left_out: int = 0
    _encodings: dict[str, set[str]] = field(default_factory=dict)
    _kinds: Counter[str] = field(default_factory=Counter)

    def admits(self, key: str, encoding: str) -> bool:
        """Return whether a sample can be recorded; one that would exceed the bounds is counted as left out."""
        known = self._encodings.get(key)
        if known is not None and encoding in known:
            return True
        if known is None:
            kind = key.split("/", 2)[1] if "/" in key else ""
            full = kind not in self._kinds and len(self._kinds) >= MOST_KINDS
            # Characters; ours have at most 150.
            if full or self._kinds[kind] >= MOST_KEYS_OF_A_KIND or len(key) > 512:
                self.left_out += 1
                return False
            self._kinds[kind] += 1
            known = self._encodings[key] = set()
        elif len(known) >= MOST_ENCODINGS_OF_A_KEY:
            self.left_out += 1
            return False
        known.add(encoding)
        return True

    def note(self, key: str, seq: int | None, size: int) -> None:
        """Count one sample that was recorded."""
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
