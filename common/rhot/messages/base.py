"""What all messages have in common: kinds of values, strictness, time and number, a pose."""

from __future__ import annotations

import math
from functools import partial
from typing import Annotated, Final, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import AfterValidator, BaseModel, ConfigDict, Field, field_validator

from rhot.text import printable

SCHEMA_VERSION: Final = 1
_QUATERNION_NORM_TOLERANCE: Final = 1e-3

NAME_PATTERN: Final = r"^[A-Za-z0-9_.-]{1,64}$"
Name = Annotated[str, Field(pattern=NAME_PATTERN)]
"""A camera, marker, joint, object or service name: it can stand as one chunk of a key."""
TimeNs = Annotated[int, Field(ge=0, lt=1 << 62)]
"""Nanoseconds since the Unix epoch, until the year 2116: what is later is garbage, and sums of two still fit."""
Count = Annotated[int, Field(ge=0, lt=1 << 63)]
Pixel = Annotated[float, Field(ge=-1e5, le=1e5)]
Metres = Annotated[float, Field(ge=-1e3, le=1e3)]
Seconds = Annotated[float, Field(ge=-1e6, le=1e6)]
Unit = Annotated[float, Field(ge=0.0, le=1.0)]


def _shown(most: int, text: str) -> str:
    return printable(text, most)[:most]


Sentence = Annotated[str, Field(max_length=4096), AfterValidator(partial(_shown, 4096))]
Label = Annotated[str, Field(max_length=64), AfterValidator(partial(_shown, 64))]
"""Text for people, without what could act on the terminal that shows it."""

PixelPoint = tuple[Pixel, Pixel]
Position = tuple[Metres, Metres, Metres]
Quaternion = tuple[float, float, float, float]

State = Literal["measured", "predicted"]
"""`measured`: backed by an observation of this moment; `predicted`: bridged by a model."""
PointState = Literal["measured", "one_view", "predicted"]
"""`measured`: by two views or more of this moment; `one_view`: on one camera's ray; `predicted`: bridged by a model."""
Side = Literal["left", "right"]


class WireModel(BaseModel):
    """Base of messages and their parts: frozen, finite, strict about types, tolerant of unknown fields."""

    model_config = ConfigDict(frozen=True, extra="ignore", strict=True, allow_inf_nan=False)


class Message(WireModel):
    """What every message carries.

    Attributes:
        t_ns: the moment the sample was true, rig clock.
        seq: counts the publisher's messages on this key from 0, so that gaps can be counted.
        schema_version: version of the model.
    """

    t_ns: TimeNs
    seq: Count = 0
    schema_version: Literal[1] = SCHEMA_VERSION


def unit_quaternion(value: Quaternion) -> Quaternion:
    """Return a quaternion as it is.

    Raises:
        ValueError: its norm is not 1.
    """
    x, y, z, w = value
    norm = math.sqrt(x * x + y * y + z * z + w * w)
    if abs(norm - 1.0) > _QUATERNION_NORM_TOLERANCE:
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
    """Return a position (3,), metres, as a message carries it."""
    x, y, z = vector.tolist()
    return x, y, z


def wire_quaternion(xyzw: NDArray[np.float64]) -> Quaternion:
    """Return a unit quaternion (4,), x y z w, as a message carries it."""
    x, y, z, w = xyzw.tolist()
    return x, y, z, w
