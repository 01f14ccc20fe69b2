"""Configuration of a running service, and files of the running rig, over the bus."""

from __future__ import annotations

import difflib
import hashlib
import json
import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Final, TypeVar

import msgpack
from pydantic import BaseModel, ValidationError

from rhot.bus import Answer, Bus, Request, json_answer
from rhot.errors import ConfigError, WireError
from rhot.messages import MAX_PAYLOAD_BYTES, first_problem, unpack
from rhot.rig.folder import RIG_FILE, settings_files
from rhot.text import printable

# The settings of the running rig over the bus, so that a recording carries them wherever it is made.
#
# Whoever owns the rig clock answers `rhot/rig` with the files of its rig folder, a msgpack map of name to content. A
# simulated rig lives in a temporary folder that nobody names, and a recorder may run on another machine than the rig.

RIG_KEY: Final = "rhot/rig"
_NAME: Final = re.compile(r"[A-Za-z0-9_-][A-Za-z0-9_.-]{0,100}")
_TIMEOUT_S: Final = 1.0


def serve_rig_files(bus: Bus, folder: Path) -> None:
    """Answer `rhot/rig` with the settings in a rig folder, as they are when somebody asks."""

    def answer(request: Request) -> Answer:
        settings = settings_files(folder)
        if request.wants_json:
            # For people, who look at everything at once.
            return json_answer({name: {"bytes": len(content)} for name, content in settings.items()})
        packed: bytes = msgpack.packb(settings)
        return Answer(packed, "application/msgpack")

    bus.queryable(RIG_KEY, answer)


async def fetch_rig_files(bus: Bus) -> dict[str, bytes]:
    """Return the settings of the running rig by name; empty where nobody answers, or with something else."""
    for reply in await bus.get(RIG_KEY, timeout_s=_TIMEOUT_S):
        if reply.error or len(reply.payload) > MAX_PAYLOAD_BYTES:
            continue
        try:
            found: Any = unpack(reply.payload)
        except WireError:
            continue
        if isinstance(found, dict) and RIG_FILE in found and all(map(_is_setting, found, found.values())):
            return found
    return {}


def _is_setting(name: Any, content: Any) -> bool:
    return isinstance(name, str) and bool(_NAME.fullmatch(name)) and isinstance(content, bytes)


# Reading and changing a service's configuration over the bus, while it runs.

C = TypeVar("C", bound=BaseModel)


def config_answer(config: BaseModel, request: Request) -> Answer:
    """Return a configuration as the request wants it: msgpack, or JSON for `?format=json`."""
    if request.wants_json:
        return json_answer(config.model_dump(mode="json"))
    packed: bytes = msgpack.packb(config.model_dump(mode="json"))
    return Answer(packed, f"application/msgpack;{type(config).__name__}")


def parse_change(payload: bytes) -> dict[str, Any]:
    """Return the fields that a put on a configuration key wants to change; JSON or msgpack.

    Raises:
        WireError: neither, or not a map.
    """
    if payload.lstrip()[:1] == b"{":
        if len(payload) > MAX_PAYLOAD_BYTES:
            raise WireError(f"payload of {len(payload)} bytes is over the limit of {MAX_PAYLOAD_BYTES}")
        try:
            change = json.loads(payload)
        except (ValueError, RecursionError) as error:
            raise WireError(f"configuration is neither JSON nor msgpack: {error}") from error
    else:
        change = unpack(payload)
    if not isinstance(change, dict):
        raise WireError(f"a configuration change must be a map of fields, got {type(change).__name__}")
    return change


def changed(config: C, change: Mapping[str, Any]) -> C:
    """Return the configuration with some fields changed; maps are merged field by field.

    Raises:
        ConfigError: an unknown field or a refused value; names it.
    """
    old = config.model_dump(mode="json")
    try:
        return type(config).model_validate(_merged(old, change))
    except ValidationError as error:
        problem = _unknown_name(old, change) or first_problem(error)
        raise ConfigError(f"configuration refused, the old one stays: {problem}") from error


def _unknown_name(old: Mapping[str, Any], change: Mapping[str, Any], parent: str = "") -> str:
    """Return what is wrong with the first name of a change that the old configuration does not have; else nothing."""
    for name, value in change.items():
        path = printable(f"{parent}{name}", 120)
        if name not in old:
            similar = difflib.get_close_matches(name, list(old), 1)
            return f"{path}: no such field" + (f"; did you mean {parent}{similar[0]}?" if similar else "")
        if isinstance(value, dict) and isinstance(old[name], dict):
            problem = _unknown_name(old[name], value, f"{path}.")
            if problem:
                return problem
    return ""


def _merged(old: Mapping[str, Any], change: Mapping[str, Any]) -> dict[str, Any]:
    result = dict(old)
    for name, value in change.items():
        before = result.get(name)
        result[name] = _merged(before, value) if isinstance(before, dict) and isinstance(value, dict) else value
    return result


def digest(config: BaseModel) -> str:
    """Return a short fingerprint of a configuration."""
    return hashlib.sha256(config.model_dump_json().encode()).hexdigest()[:12]
