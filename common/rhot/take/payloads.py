"""Many payloads of one key as columns of numbers, without a message object for each.

Messages of one model mostly have the same structure: the same maps, names and words, in which only numbers differ, and
msgpack gives a number of one kind the same length. The first payload of a structure is a template: it is checked by the
model, and the places of its numbers are noted. Payloads that equal it in all other bytes are then read together, as
columns of one array of bytes. Ten minutes at 120 Hz take a second that way and half a minute message by message.
"""

from __future__ import annotations

import struct
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from rhot.arrays import FloatArray
from rhot.errors import WireError
from rhot.messages import Message, decode

Path = tuple[str | int, ...]
"""Where a value is: keys of maps and indices of arrays, such as `("joints", "wrist", "position", 0)`."""

_NUMBERS: Final = {
    0xCA: ">f4",
    0xCB: ">f8",
    0xCC: ">u1",
    0xCD: ">u2",
    0xCE: ">u4",
    0xCF: ">u8",
    0xD0: ">i1",
    0xD1: ">i2",
    0xD2: ">i4",
    0xD3: ">i8",
}
"""Type bytes of msgpack that a number follows, with its kind (msgpack specification, "Formats")."""
_SMALL: Final = "u1"
"""A positive fixint: its type byte is the number, below 128."""
_BATCH: Final = 4096
_MOST_TEMPLATES: Final = 512
"""Kept for later batches; the structure of a hand has about a hundred: which fingers are measured."""


@dataclass(frozen=True, slots=True)
class Group:
    """Messages of one structure.

    Attributes:
        rows: (N,) their numbers among all messages of the key.
        first: one of them, for what is no number.
        blocks: paths of P numbers of one kind and their values (N, P): float64, or int64 for whole numbers.
    """

    rows: NDArray[np.int64]
    first: Message
    blocks: list[tuple[list[Path], NDArray[Any]]]


@dataclass(slots=True)
class _Template:
    """A structure; `first` is None where the model refuses it."""

    bytes: NDArray[np.uint8]
    fixed: NDArray[np.uint8]
    places: dict[str, tuple[list[Path], list[int]]]
    first: Message | None
    used: int = 0


@dataclass(slots=True)
class PayloadColumns:
    """The payloads of one key, which are added one by one.

    Attributes:
        model: of the key's messages.
        count: payloads added.
        invalid: those that are no valid messages.
    """

    model: type[Message]
    count: int = 0
    invalid: int = 0
    _groups: list[Group] = field(default_factory=list)
    _waiting: list[bytes] = field(default_factory=list)
    _templates: dict[int, list[_Template]] = field(default_factory=dict)

    def add(self, *payloads: bytes) -> None:
        """Add payloads."""
        self._waiting += payloads
        self.count += len(payloads)
        if len(self._waiting) >= _BATCH:
            self._read()

    def groups(self) -> list[Group]:
        """Return all valid messages."""
        self._read()
        return self._groups

    def _read(self) -> None:
        begin = self.count - len(self._waiting)
        lengths = np.array([len(payload) for payload in self._waiting])
        for length in np.unique(lengths):
            rows = np.flatnonzero(lengths == length)
            joined = b"".join(self._waiting[row] for row in rows)
            self._read_alike(rows + begin, np.frombuffer(joined, np.uint8).reshape(len(rows), length))
        self._waiting.clear()

    def _read_alike(self, rows: NDArray[np.int64], table: NDArray[np.uint8]) -> None:
        """Read payloads of one length, (N, L) bytes."""
        known = self._templates.setdefault(table.shape[1], [])
        known.sort(key=lambda template: -template.used)
        tried = 0
        while len(rows):
            if tried == len(known):
                if len(known) >= _MOST_TEMPLATES:
                    known.clear()
                    tried = 0
                known.append(_template(table[0].tobytes(), self.model))
            template = known[tried]
            tried += 1
            fits = ~(((table ^ template.bytes) & template.fixed).any(axis=1))
            if not fits.any():
                continue
            template.used += int(np.count_nonzero(fits))
            self._take(template, rows[fits], table[fits])
            rows, table = rows[~fits], table[~fits]

    def _take(self, template: _Template, rows: NDArray[np.int64], table: NDArray[np.uint8]) -> None:
        if template.first is None:
            self.invalid += len(rows)
            return
        found: dict[str, NDArray[Any]] = {}
        sound = np.ones(len(rows), bool)
        for kind, (_, offsets) in template.places.items():
            found[kind] = np.empty((len(rows), len(offsets)), np.float64 if "f" in kind else np.int64)
            for column, offset in enumerate(offsets):
                found[kind][:, column] = np.ndarray(len(rows), kind, table, offset, table.strides[:1])
            if "f" in kind:
                sound &= np.isfinite(found[kind]).all(axis=1)
        if not sound.all():
            self.invalid += len(rows) - int(np.count_nonzero(sound))
            rows, found = rows[sound], {kind: values[sound] for kind, values in found.items()}
        if len(rows):
            blocks = [(paths, found[kind]) for kind, (paths, _) in template.places.items()]
            self._groups.append(Group(rows, template.first, blocks))


def _template(payload: bytes, model: type[Message]) -> _Template:
    places: dict[str, tuple[list[Path], list[int]]] = {}
    try:
        first: Message | None = decode(payload, model)
        for path, kind, offset in _walk(payload):
            paths, offsets = places.setdefault(kind, ([], []))
            paths.append(path)
            offsets.append(offset)
    except (WireError, ValueError, IndexError, struct.error):
        first, places = None, {}
    fixed = np.full(len(payload), 0xFF, np.uint8)
    for kind, (_, offsets) in places.items():
        for offset in offsets:
            fixed[offset : offset + np.dtype(kind).itemsize] = 0
    # Of a positive fixint the first bit is fixed.
    small = places.get(_SMALL, ([], []))[1]
    fixed[small] = 0x80
    return _Template(np.frombuffer(payload, np.uint8), fixed, places, first)


def _walk(payload: bytes) -> Iterator[tuple[Path, str, int]]:
    """Yield path, kind and offset of every number of a msgpack payload.

    Raises:
        ValueError: it holds what our messages do not.
    """
    at = 0

    def length(size: int) -> int:
        nonlocal at
        value = int.from_bytes(payload[at : at + size], "big")
        at += size
        return value

    def value(path: Path) -> Iterator[tuple[Path, str, int]]:
        nonlocal at
        kind = payload[at]
        at += 1
        if kind < 0x80:
            yield path, _SMALL, at - 1
        elif kind in _NUMBERS:
            yield path, _NUMBERS[kind], at
            at += np.dtype(_NUMBERS[kind]).itemsize
        elif 0x80 <= kind <= 0x8F or kind in (0xDE, 0xDF):
            for _ in range(kind & 0x0F if kind <= 0x8F else length(2 if kind == 0xDE else 4)):
                yield from value((*path, word()))
        elif 0x90 <= kind <= 0x9F or kind in (0xDC, 0xDD):
            for index in range(kind & 0x0F if kind <= 0x9F else length(2 if kind == 0xDC else 4)):
                yield from value((*path, index))
        elif 0xA0 <= kind <= 0xBF or kind in (0xD9, 0xDA, 0xDB):
            at -= 1
            word()
        elif kind not in (0xC0, 0xC2, 0xC3) and kind < 0xE0:
            raise ValueError(f"type {kind:#x} of msgpack is none of our messages'")

    def word() -> str:
        nonlocal at
        kind = payload[at]
        at += 1
        if 0xA0 <= kind <= 0xBF:
            size = kind & 0x1F
        elif kind in (0xD9, 0xDA, 0xDB):
            size = length({0xD9: 1, 0xDA: 2, 0xDB: 4}[kind])
        else:
            raise ValueError("a key is no text")
        text = payload[at : at + size].decode()
        at += size
        return text

    yield from value(())


def table_of(groups: Sequence[Group], layout: Mapping[Path, int], count: int) -> FloatArray:
    """Return numbers as a table (count, C), NaN where a message has none.

    Args:
        groups: of all messages.
        layout: path to column.
        count: of messages.
    """
    table = np.full((count, max(layout.values(), default=-1) + 1), np.nan)
    columns: dict[int, NDArray[np.int64]] = {}
    for group in groups:
        for paths, values in group.blocks:
            # All groups of a structure share its list of paths.
            chosen = columns.get(id(paths))
            if chosen is None:
                pairs = [(index, layout[path]) for index, path in enumerate(paths) if path in layout]
                chosen = columns[id(paths)] = np.array(pairs, np.int64).reshape(-1, 2)
            if len(chosen):
                table[group.rows[:, None], chosen[:, 1]] = values[:, chosen[:, 0]]
    return table


def whole_numbers(groups: Sequence[Group], path: Path, count: int) -> NDArray[np.int64]:
    """Return whole numbers (count,) at a path; −1 where a message has none."""
    column = np.full(count, -1, np.int64)
    for group in groups:
        for paths, values in group.blocks:
            if path in paths:
                column[group.rows] = values[:, paths.index(path)]
    return column


def words(groups: Sequence[Group], word: Callable[[Any], str], count: int) -> NDArray[np.str_]:
    """Return words (count,) of each message's structure, such as its state; empty where a message is not valid."""
    found = [(group, word(group.first)) for group in groups]
    column = np.full(count, "", dtype=f"<U{max((len(text) for _, text in found), default=1)}")
    for group, text in found:
        column[group.rows] = text
    return column
