"""Single values changed in the text of a TOML file: comments, order and everything else stay as people wrote them."""

from __future__ import annotations

import json
import re
import tomllib
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Final

from pydantic import ValidationError

from rhot.errors import ConfigError
from rhot.messages import first_problem
from rhot.rig.config import RigConfig
from rhot.rig.folder import RIG_FILE, write_text_atomic

Value = str | int | float | Sequence[float]
"""What can be written: a text, a number, or a list of numbers."""

_TABLE: Final = re.compile(r"^\s*\[(?!\[)\s*(?P<path>[^\]]+?)\s*\]\s*(#.*)?$")
_ENTRY: Final = re.compile(r"^\s*(?P<key>[A-Za-z0-9_-]+|\"[^\"]*\")\s*=\s*(?P<rest>.*)$")
_VALUE: Final = re.compile(r"(?P<value>\"[^\"\\]*\"|'[^']*'|\[[^\[\]\"'#]*\]|[^\s#\"'\[\]{}]+)(?P<rest>\s*(#.*)?)$")


def with_values(text: str, table: Sequence[str], values: Mapping[str, Value]) -> str:
    """Return the text of a TOML file with some values of one table set.

    Args:
        text: of the whole file, valid TOML.
        table: names on the way to the table, such as `("cameras", "left")`.
        values: key to new value; a key that is not there is added at the end of the table, before blank lines.

    Raises:
        ConfigError: the file writes the table or a value in a form that cannot be changed in place (an inline or
            dotted table, a value over several lines); names it.
    """
    refusal = ConfigError(
        f"[{'.'.join(table)}] is not there or is written in a form that cannot be changed in place; set "
        f"{', '.join(f'{key} = {_written(value)}' for key, value in values.items())} there by hand"
    )
    lines = text.splitlines(keepends=True)
    span = _span(lines, tuple(table))
    if span is None:
        raise refusal
    begin, end = span
    for key, value in values.items():
        place = next((number for number in range(begin, end) if _key_of(lines[number]) == key), None)
        if place is None:
            last = max((n for n in range(begin, end) if _key_of(lines[n]) is not None), default=begin - 1)
            if last >= 0 and not lines[last].endswith("\n"):
                lines[last] += "\n"
            lines.insert(last + 1, f"{key} = {_written(value)}\n")
            end += 1
        else:
            line = _replaced(lines[place], value)
            if line is None:
                raise refusal
            lines[place] = line
    changed = "".join(lines)
    if _content(changed) != _expected(text, table, values):
        raise refusal
    return changed


def change_rig_file(rig_path: Path, changes: Mapping[tuple[str, ...], Mapping[str, Value]]) -> None:
    """Set values of `rig.toml`, by table; all of them or, with an error, none.

    Raises:
        ConfigError: the file cannot be read, changed in place or written, or a value is not valid.
    """
    file = rig_path / RIG_FILE
    try:
        text = file.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        raise ConfigError(f"{file}: cannot be read: {error}") from error
    try:
        for table, values in changes.items():
            text = with_values(text, table, values)
        RigConfig.model_validate(tomllib.loads(text))
    except ValidationError as error:
        raise ConfigError(f"{file}: stays as it is: {first_problem(error)}") from error
    except ConfigError as error:
        raise ConfigError(f"{file}: stays as it is: {error}") from error
    write_text_atomic(file, text)


def _span(lines: Sequence[str], table: tuple[str, ...]) -> tuple[int, int] | None:
    """Return the first line after a table's heading, and the line of the next heading; None without a heading."""
    begin = None
    for number, line in enumerate(lines):
        if not line.lstrip().startswith("["):
            continue
        if begin is not None and (_TABLE.match(line) or line.lstrip().startswith("[[")):
            return begin, number
        heading = _TABLE.match(line)
        if heading and _path(heading["path"]) == table:
            begin = number + 1
    return None if begin is None else (begin, len(lines))


def _path(heading: str) -> tuple[str, ...]:
    return tuple(part.strip().strip("\"'") for part in heading.split("."))


def _key_of(line: str) -> str | None:
    entry = _ENTRY.match(line)
    return None if entry is None else entry["key"].strip('"')


def _replaced(line: str, value: Value) -> str | None:
    entry = _ENTRY.match(line)
    found = None if entry is None else _VALUE.match(entry["rest"])
    if entry is None or found is None:
        return None
    ending = line[len(line.rstrip("\r\n")) :]
    return line[: entry.start("rest")] + _written(value) + found["rest"].rstrip("\r\n") + ending


def _written(value: Value) -> str:
    if isinstance(value, str):
        return json.dumps(value, ensure_ascii=False)
    if isinstance(value, int | float):
        return f"{value!r}"
    return f"[{', '.join(_written(float(each)) for each in value)}]"


def _content(text: str) -> dict[str, Any] | None:
    try:
        return tomllib.loads(text)
    except tomllib.TOMLDecodeError:
        return None


def _expected(text: str, table: Sequence[str], values: Mapping[str, Value]) -> dict[str, Any] | None:
    content = _content(text)
    place: Any = content
    for name in table:
        place = place.get(name) if isinstance(place, dict) else None
    if not isinstance(place, dict):
        return None
    place.update({key: value if isinstance(value, str | int | float) else list(value) for key, value in values.items()})
    return content
