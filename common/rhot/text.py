"""Text from outside, made harmless: the one function that stands between the network and terminals, logs and markup.

Keys, names and error texts on the bus are chosen by whoever publishes them. An escape sequence in one of them moves the
cursor of the terminal that shows it, a newline forges a line of a log, and a bidirectional override hides what a name
says. `printable` writes all of these as the escapes that JSON uses, so that it may also stand in a line of JSON.
"""

from __future__ import annotations

import codecs
import json
import logging
import os
import shlex
import threading
import time
import tomllib
import unicodedata
from pathlib import Path
from typing import Any, Final

# Text files that people and other programs write: TOML, JSON and tables, whatever editor saved them.
#
# Editors of Windows put a byte order mark in front of a text, or save it as UTF-16. Neither is an error here. What a
# parser would accept in silence or end on in a traceback is one: a key that is there twice, of which the first is lost,
# and nesting that is deeper than the interpreter's stack.

_UTF16: Final = (codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE)
_TOO_DEEP: Final = "nested too deeply"


def read_text(file: Path) -> str:
    """Return the text of a file: UTF-8, or UTF-16 with its byte order mark; the mark itself is left out.

    Raises:
        OSError: it cannot be read.
        UnicodeDecodeError: it is no such text.
    """
    data = file.read_bytes()
    return data.decode("utf-16" if data.startswith(_UTF16) else "utf-8-sig")


def parse_toml(text: str) -> dict[str, Any]:
    """Return the content of a TOML text.

    Raises:
        ValueError: it is none.
    """
    try:
        return tomllib.loads(text)
    except RecursionError as error:
        raise ValueError(_TOO_DEEP) from error


def parse_json(text: str) -> Any:
    """Return the content of a JSON text.

    Raises:
        ValueError: it is none, or a key of an object is there twice.
    """
    try:
        return json.loads(text, object_pairs_hook=_without_repeats)
    except RecursionError as error:
        raise ValueError(_TOO_DEEP) from error


def _without_repeats(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    found: dict[str, Any] = {}
    for key, value in pairs:
        if key in found:
            raise ValueError(f"the key {key[:60]!r} is there twice; remove one")
        found[key] = value
    return found


# Saying the same thing at most once in a while: what others send must not fill a disk with our logs.

INTERVAL_S: Final = 5.0


class SparingLog:
    """Tells whether a topic's turn to be logged has come; may be asked from any thread."""

    def __init__(self, interval_s: float = INTERVAL_S) -> None:
        self._interval_s = interval_s
        self._lock = threading.Lock()
        self._logged_at: dict[str, float] = {}
        self._kept_quiet: dict[str, int] = {}

    def due(self, topic: str) -> int | None:
        """Return how often the topic was kept quiet since it was last due; None when it is not due yet."""
        now = time.monotonic()
        with self._lock:
            # Topics are keys, which an outsider may choose: the table must not grow with them.
            most_topics = 64
            if topic not in self._logged_at and len(self._logged_at) >= most_topics:
                topic = "…"
            last = self._logged_at.get(topic)
            if last is not None and now - last < self._interval_s:
                self._kept_quiet[topic] = self._kept_quiet.get(topic, 0) + 1
                return None
            self._logged_at[topic] = now
            return self._kept_quiet.pop(topic, 0)


MOST_CHARACTERS: Final = 2000
"""Longest text from outside that is shown or logged; chosen: about a screen."""
_HARMFUL: Final = frozenset({"Cc", "Cf", "Cs", "Co", "Cn", "Zl", "Zp"})
"""Unicode categories (UAX #44, table 12): control, format, surrogate, private, unassigned, line and paragraph ends."""
_SHORT: Final = {"\n": "\\n", "\r": "\\r", "\t": "\\t"}


def printable(text: str, limit: int = MOST_CHARACTERS) -> str:
    r"""Return a text on one line, without control characters, and no longer than `limit`.

    Ordinary text comes back as it is. What could act on a terminal is written as its escape: `\u001b`, `\n`.
    """
    if len(text) > limit:
        text = f"{text[: limit - 1]}…"
    if text.isascii() and text.isprintable():
        return text
    return "".join(map(_escaped, text))


def printable_lines(text: str) -> str:
    """Return a text of several lines with each made printable; for errors of ours that quote the end of a log."""
    return "\n".join(printable(line) for line in text[: 20 * MOST_CHARACTERS].split("\n"))


def as_argument(path: str | os.PathLike[str]) -> str:
    """Return a path as a word of a command to paste into a shell: quoted where it holds spaces and the like."""
    return shlex.quote(printable(os.fspath(path)))


class PrintableFormatter(logging.Formatter):
    """Writes each log record on one line, whatever its arguments hold; only a traceback of ours has more."""

    def formatMessage(self, record: logging.LogRecord) -> str:  # logging's own name
        """Return the line of a record."""
        record.message = printable(record.message)
        return super().formatMessage(record)

    def formatException(self, ei: logging._SysExcInfoType) -> str:
        """Return a traceback; its last lines quote what came from outside."""
        return printable_lines(super().formatException(ei))


def _escaped(character: str) -> str:
    if unicodedata.category(character) not in _HARMFUL:
        return character
    short = _SHORT.get(character)
    if short is not None:
        return short
    number = ord(character)
    if number < 0x10000:
        return f"\\u{number:04x}"
    # As JSON does it: a pair of surrogates.
    number -= 0x10000
    return f"\\u{0xD800 + (number >> 10):04x}\\u{0xDC00 + (number & 0x3FF):04x}"
