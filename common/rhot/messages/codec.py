"""Encoding of messages to payloads and back."""

from __future__ import annotations

from typing import Any, Final, TypeVar

import msgpack
from pydantic import ValidationError

from rhot.errors import WireError
from rhot.messages.base import Message, first_problem

MAX_PAYLOAD_BYTES: Final = 1 << 20
"""Size of the largest payload that is decoded; a full HandPose has about 3 kB."""

M = TypeVar("M", bound=Message)


def encoding_of(model: type[Message]) -> str:
    """Return the Zenoh encoding of a model's payloads."""
    return f"application/msgpack;{model.__name__}"


def encode(message: Message) -> bytes:
    """Return the msgpack payload of a message; fields that are None are left out."""
    packed: bytes = msgpack.packb(message.model_dump(mode="python", exclude_none=True))
    return packed


def unpack(payload: bytes) -> Any:
    """Return the Python value of a msgpack payload, arrays as tuples.

    Raises:
        WireError: the payload is too large or not msgpack.
    """
    if len(payload) > MAX_PAYLOAD_BYTES:
        raise WireError(f"payload of {len(payload)} bytes is over the limit of {MAX_PAYLOAD_BYTES}")
    try:
        return msgpack.unpackb(payload, use_list=False, strict_map_key=True)
    except (ValueError, TypeError, OverflowError, RecursionError, msgpack.UnpackException) as error:
        raise WireError(f"payload of {len(payload)} bytes is not msgpack: {error or type(error).__name__}") from error


def decode(payload: bytes, model: type[M]) -> M:
    """Return the message in a payload.

    Raises:
        WireError: not msgpack, or not a valid `model`; names the first offending field.
    """
    try:
        return model.model_validate(unpack(payload))
    except ValidationError as error:
        raise WireError(f"not a valid {model.__name__}: {first_problem(error)}") from error


def with_seq(message: M, seq: int) -> M:
    """Return a copy of the message with its sequence number set, for publishers."""
    return message.model_copy(update={"seq": seq})
