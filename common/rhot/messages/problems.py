"""Validation errors of messages and files as one line for people."""

from __future__ import annotations

import difflib
from typing import Any, get_args

from pydantic import BaseModel, ValidationError

from rhot.messages.base import NAME_PATTERN
from rhot.text import printable


def first_problem(error: ValidationError, model: type[BaseModel] | None = None) -> str:
    """Return one line with the first offending field of a validation error, its value, and the number of further ones.

    Args:
        error: raised by pydantic.
        model: the validated model; used to suggest the right name of a misspelt field.
    """
    problems = error.errors(include_url=False)
    first = problems[0]
    # "[key]" repeats the name of a table, with which the path already ends.
    where = printable(".".join(str(part) for part in first["loc"] if part != "[key]"), 120) or "(whole)"
    if first["type"] == "missing":
        text = f"{where}: is missing"
    elif first["type"] == "extra_forbidden":
        *parents, name = first["loc"]
        similar = difflib.get_close_matches(str(name), _fields_below(model, parents), 1)
        text = f"{where}: no such field" + (f"; did you mean {similar[0]}?" if similar else "")
    elif first.get("ctx", {}).get("pattern") == NAME_PATTERN:
        text = f"{where}: a name is made of letters, digits, _, . and -, 64 at most, got {_short(first['input'])}"
    else:
        text = f"{where}: {printable(first['msg'].removeprefix('Value error, '))}, got {_short(first['input'])}"
    return text if len(problems) == 1 else f"{text} (and {len(problems) - 1} more)"


def _short(value: object) -> str:
    text = repr(value)
    return text if len(text) <= 80 else f"{text[:77]}…"


def _fields_below(model: type[BaseModel] | None, location: list[Any]) -> list[str]:
    """Return the fields of the models at a location; keys of maps, indices and tags of unions are skipped."""
    found = [] if model is None else [model]
    for part in location:
        fields = [each.model_fields[part] for each in found if part in each.model_fields]
        found = [below for field in fields for below in _models(field.annotation)] or found
    return [name for each in found for name in each.model_fields]


def _models(annotation: Any) -> list[type[BaseModel]]:
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        return [annotation]
    return [model for argument in get_args(annotation) for model in _models(argument)]
