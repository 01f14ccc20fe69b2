"""The settings of the running rig over the bus, so that a recording carries them wherever it is made.

Whoever owns the rig clock answers `rhot/rig` with the files of its rig folder, a msgpack map of name to content. A
simulated rig lives in a temporary folder that nobody names, and a recorder may run on another machine than the rig.
"""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any, Final

import msgpack

from rhot.bus import Answer, Bus, Request, json_answer
from rhot.errors import WireError
from rhot.messages import MAX_PAYLOAD_BYTES, unpack
from rhot.rig.folder import RIG_FILE, settings_files

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
