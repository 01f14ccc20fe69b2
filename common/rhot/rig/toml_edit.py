"""Single values changed in a TOML file: comments, order and everything else stay as people wrote them."""

from __future__ import annotations

from collections.abc import Mapping, MutableMapping, Sequence
from pathlib import Path
from typing import Any

import tomlkit
from pydantic import ValidationError
from tomlkit.exceptions import TOMLKitError
from tomlkit.items import AbstractTable

from rhot.atomic_file import locked, why_unread
from rhot.errors import ConfigError
from rhot.messages import first_problem
from rhot.rig.config import RigConfig
from rhot.rig.folder import RIG_FILE, write_text_atomic
from rhot.text import parse_toml

Value = str | int | float | Sequence[float] | Sequence[str]
"""What can be written: a text, a number or truth value, or a list of numbers or texts."""


def with_values(text: str, table: Sequence[str], values: Mapping[str, Value]) -> str:
    """Return the text of a TOML file with some values of one table set.

    Args:
        text: of the whole file.
        table: names on the way to the table, such as `("cameras", "left")`.
        values: key to new value; a key that is not there is added at the end of the table.

    Raises:
        ConfigError: the text is not valid TOML or holds no such table.
    """
    try:
        document = tomlkit.parse(text)
    except (TOMLKitError, RecursionError) as error:
        raise ConfigError(str(error)) from error
    found: Any = document
    for name in table:
        found = found.get(name) if isinstance(found, MutableMapping) else None
    if not isinstance(found, MutableMapping):
        raise ConfigError(f"[{'.'.join(table)}] is not there; add it by hand")
    newline = "\r\n" if "\r\n" in text else "\n"
    for key, value in values.items():
        _set(found, key, value, newline)
    return tomlkit.dumps(document)


def _set(table: MutableMapping[str, Any], key: str, value: Value, newline: str) -> None:
    if isinstance(value, str | int | float):
        item = tomlkit.item(value)
    else:
        item = tomlkit.item([each if isinstance(each, str) else float(each) for each in value])
    item.trivia.trail = newline
    # A comment before the next heading counts as the end of this table; what is added belongs before it.
    body = table.value.body if isinstance(table, AbstractTable) and key not in table else []
    end = len(body)
    while end and body[end - 1][0] is None:
        end -= 1
    after = body[end:]
    del body[end:]
    table[key] = item
    body.extend(after)


def change_rig_file(rig_path: Path, changes: Mapping[tuple[str, ...], Mapping[str, Value]]) -> None:
    """Set values of `rig.toml`, by table; all of them or, with an error, none.

    Two processes that change it at the same moment do so one after the other: neither loses the other's change.

    Raises:
        ConfigError: the file cannot be read, changed or written, or a value is not valid.
    """
    with locked(rig_path):
        _change(rig_path / RIG_FILE, changes)


def _change(file: Path, changes: Mapping[tuple[str, ...], Mapping[str, Value]]) -> None:
    try:
        # As bytes: line ends stay as they are. A byte order mark does not.
        text = file.read_bytes().decode("utf-8-sig")
    except (OSError, UnicodeDecodeError) as error:
        raise ConfigError(f"{file}: cannot be read: {why_unread(error)}") from error
    try:
        for table, values in changes.items():
            text = with_values(text, table, values)
        RigConfig.model_validate(parse_toml(text))
    except ValidationError as error:
        raise ConfigError(f"{file}: stays as it is: {first_problem(error, RigConfig)}") from error
    except ConfigError as error:
        raise ConfigError(f"{file}: stays as it is: {error}") from error
    write_text_atomic(file, text)
