"""Text from outside, made harmless: the one function that stands between the network and terminals, logs and markup.

Keys, names and error texts on the bus are chosen by whoever publishes them. An escape sequence in one of them moves the
cursor of the terminal that shows it, a newline forges a line of a log, and a bidirectional override hides what a name
says. `printable` writes all of these as the escapes that JSON uses, so that it may also stand in a line of JSON.
"""

from __future__ import annotations

import logging
import os
import shlex
import unicodedata
from typing import Final

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


def printable_lines(text: str, limit: int = 20 * MOST_CHARACTERS) -> str:
    """Return a text of several lines with each made printable; for errors of ours that quote the end of a log."""
    return "\n".join(printable(line) for line in text[:limit].split("\n"))


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
