"""The Zenoh configuration of a session: limits, timeouts and, on a secured bus, certificates and who may do what."""

from __future__ import annotations

import json
import re
from typing import Any

import zenoh

from rhot.bus.limits import MAX_MESSAGE_BYTES
from rhot.errors import BusError
from rhot.rig.config import BusConfig


def session_config(config: BusConfig) -> zenoh.Config:
    """Return the Zenoh configuration of a session.

    It is handed over as one document: nested keys such as `connect/retry` are refused one by one.

    Raises:
        BusError: it is not usable.
    """
    document: dict[str, Any] = {
        "mode": config.mode,
        "connect": {
            "endpoints": list(config.connect),
            # A router that was killed and came back is used again after half a second instead of four.
            "retry": {"period_init_ms": 200, "period_max_ms": 500, "period_increase_factor": 1.5},
        },
        "listen": {"endpoints": list(config.listen)},
        "scouting": {"multicast": {"enabled": config.multicast}, "gossip": {"enabled": config.multicast}, "delay": 0},
        "transport": {
            # On by default from 3 kB; drops under load without a word.
            "shared_memory": {"enabled": False},
            # The kernel repeats an unanswered SYN after 1, 3, 7, 15 s: after a dead network an old attempt would hear
            # of the new one seconds late. It is given up and begun anew instead; Zenoh's own limit is 10 s.
            "unicast": {"open_timeout": 1500},
            "link": {
                # A frozen process is noticed in 2 s instead of 10.
                "tx": {"lease": 2000},
                # Without it one message may take 1 GiB of every process that hears it.
                "rx": {"max_message_size": MAX_MESSAGE_BYTES},
            },
        },
    }
    if config.namespace:
        document["namespace"] = config.namespace
    try:
        return zenoh.Config.from_json5(json.dumps(document))
    except zenoh.ZError as error:
        raise BusError(f"[bus] in rig.toml is not a usable Zenoh configuration: {plain_reason(error)}") from error


def plain_reason(error: zenoh.ZError) -> str:
    """Return Zenoh's words without the places in its own source code."""
    return re.sub(r"( at \S+\.rs:\d+\.?|[\[\]])", "", str(error)).strip()
