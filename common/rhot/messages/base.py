"""Common parts of all messages: value types, base models, a pose, and validation errors as one line for people."""

from __future__ import annotations

import difflib
import math
from functools import partial
from typing import Annotated, Any, Final, Literal, get_args

import numpy as np
from numpy.typing import NDArray
from pydantic import AfterValidator, BaseModel, ConfigDict, Field, Strict, ValidationError, field_validator

from rhot.text import printable

# Validation errors of messages and files as one line for people.


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


# Common parts of all messages: value types, the base models, and a pose.

SCHEMA_VERSION: Final = 1

NAME_PATTERN: Final = r"^[A-Za-z0-9_.-]{1,64}$"
Name = Annotated[str, Field(pattern=NAME_PATTERN)]
"""Name of a camera, marker, joint, object or service; valid as one chunk of a key."""
TimeNs = Annotated[int, Field(ge=0, lt=1 << 62)]
"""Nanoseconds since the Unix epoch, up to the year 2116, so that the sum of two fits into 64 bits."""
Count = Annotated[int, Field(ge=0, lt=1 << 63)]
Pixel = Annotated[float, Field(ge=-1e5, le=1e5)]
Metres = Annotated[float, Field(ge=-1e3, le=1e3)]
Seconds = Annotated[float, Field(ge=-1e6, le=1e6)]
Unit = Annotated[float, Field(ge=0.0, le=1.0)]
SignedUnit = Annotated[float, Field(ge=-1.0, le=1.0)]


def _shown(most: int, text: str) -> str:
    return printable(text, most)[:most]


Sentence = Annotated[str, Field(max_length=4096), AfterValidator(partial(_shown, 4096))]
Label = Annotated[str, Field(max_length=64), AfterValidator(partial(_shown, 64))]
"""Text for people, without control characters that could act on a terminal."""

Listed = Strict(False)
"""For tuples, which JSON and msgpack give as lists; what is in them stays strict."""
PixelPoint = Annotated[tuple[Pixel, Pixel], Listed]
Position = Annotated[tuple[Metres, Metres, Metres], Listed]
Quaternion = Annotated[tuple[float, float, float, float], Listed]


class WireModel(BaseModel):
    """Base of messages and their parts: frozen, finite values, strict types, unknown fields ignored."""

    model_config = ConfigDict(frozen=True, extra="ignore", strict=True, allow_inf_nan=False)


class Message(WireModel):
    """Fields of every message.

    Attributes:
        t_ns: time of the sample, rig clock.
        seq: number of the message on this key since the publisher started, from 0; a gap means lost messages.
        schema_version: version of the model.
    """

    t_ns: TimeNs
    seq: Count = 0
    schema_version: Literal[1] = SCHEMA_VERSION


def unit_quaternion(value: Quaternion) -> Quaternion:
    """Validate a quaternion x, y, z, w and return it unchanged.

    Raises:
        ValueError: its norm is not 1.
    """
    x, y, z, w = value
    norm = math.sqrt(x * x + y * y + z * z + w * w)
    quaternion_norm_tolerance = 1e-3
    if abs(norm - 1.0) > quaternion_norm_tolerance:
        raise ValueError(f"quaternion (x, y, z, w) has norm {norm:.6g}, must be 1")
    return value


class Pose(WireModel):
    """A position and an orientation.

    Attributes:
        position: metres.
        orientation: unit quaternion x, y, z, w.
    """

    position: Position
    orientation: Quaternion

    _norm = field_validator("orientation")(unit_quaternion)


def wire_position(vector: NDArray[np.float64]) -> Position:
    """Return a position (3,), metres, as a tuple for a message."""
    x, y, z = vector.tolist()
    return x, y, z


def wire_quaternion(xyzw: NDArray[np.float64]) -> Quaternion:
    """Return a unit quaternion (4,), x y z w, as a tuple for a message."""
    x, y, z, w = xyzw.tolist()
    return x, y, z, w
