"""Which message model a payload holds: by its Zenoh encoding, or by its key where only that is known."""

from __future__ import annotations

import json
from functools import cache
from typing import Final

from rhot import messages
from rhot.messages import Message

MSGPACK_ENCODING: Final = "application/msgpack"

_BY_KEY: Final[dict[str, type[Message]]] = {
    "markers": messages.MarkerFrame,
    "points": messages.PointSet,
    "hand": messages.HandPose,
    "object": messages.ObjectPose,
    "head": messages.HeadPose,
    "foot": messages.FootPose,
    "body": messages.BodyPose,
    "space": messages.Space,
    "control": messages.Control,
    "status": messages.ServiceStatus,
    "truth": messages.Truth,
    "event": messages.Event,
}
"""Second chunk of the key to the model on it."""


@cache
def model_named(name: str) -> type[Message] | None:
    """Return the message model of a name, None where there is none."""
    model = getattr(messages, name, None)
    return model if isinstance(model, type) and issubclass(model, Message) else None


def model_of_encoding(encoding: str) -> type[Message] | None:
    """Return the model that a Zenoh encoding such as `application/msgpack;HandPose` names, None where it names none."""
    kind, _, name = encoding.partition(";")
    return model_named(name) if kind == MSGPACK_ENCODING and name else None


def model_of_key(key: str) -> type[Message] | None:
    """Return the model of all messages on a key, None for keys that carry none (configuration, for example)."""
    root, _, rest = key.partition("/")
    return _BY_KEY.get(rest.partition("/")[0]) if root == "rhot" else None


@cache
def json_schema(model: type[Message]) -> bytes:
    """Return a model's JSON schema."""
    return json.dumps(model.model_json_schema()).encode()
