"""Text files that people and other programs write: TOML, JSON and tables, whatever editor saved them.

Editors of Windows put a byte order mark in front of a text, or save it as UTF-16. Neither is an error here. What a
parser would accept in silence or end on in a traceback is one: a key that is there twice, of which the first is lost,
and nesting that is deeper than the interpreter's stack.
"""

from __future__ import annotations

import codecs
import json
import tomllib
from pathlib import Path
from typing import Any, Final

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
