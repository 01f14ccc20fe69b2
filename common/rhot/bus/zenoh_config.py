"""The Zenoh configuration of a session: limits, timeouts and, on a secured bus, certificates and who may do what."""

from __future__ import annotations

import json
import re
import threading
from collections import Counter
from pathlib import Path
from typing import Any, Final

import zenoh

from rhot.errors import BusError
from rhot.keys import ROUTER, access_control, credentials, load_roles
from rhot.rig.sections import BusConfig

# How much of what the network sends may pile up in one process, and how often that much was reached.

MAX_MESSAGE_BYTES: Final = 8 << 20
"""Zenoh puts no larger message together; its default is 1 GiB. Chosen: a preview of 12 megapixels takes 5 MB."""
MAX_SAMPLE_BYTES: Final = 1 << 20
"""A larger sample is not copied: no message of ours may be as large (`rhot.messages.MAX_PAYLOAD_BYTES`)."""
MAX_QUESTION_BYTES: Final = 256 << 10
"""Of what may come with a question: a change of a configuration takes some kB."""
MAX_UNREAD_BYTES: Final = 64 << 20
"""Of samples that one subscriber has not read yet; chosen: 700 pictures of 640x480."""
MAX_KNOWN_KEYS: Final = 64
"""Keys of a latest-only subscriber that have brought valid messages: as many as a rig may have cameras."""
MAX_FOREIGN_KEYS: Final = 64
"""Further keys that it keeps a slot for at any moment."""
MAX_WAITING_ANSWERS: Final = 16
"""Questions that may wait for a worker; chosen: a page per person in a room asks each camera once a second."""
MAX_REPLIES: Final = 4096
MAX_REPLY_BYTES: Final = 64 << 20
"""Of all answers to one question."""


class LimitCounts:
    """How often each limit was reached; the status shows those that were."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._counts: Counter[str] = Counter()

    def hit(self, name: str) -> None:
        """Count what a limit kept out; any thread may call it."""
        with self._lock:
            self._counts[name] += 1

    def counts(self) -> dict[str, int]:
        """Return what was kept out so far, by name."""
        with self._lock:
            return dict(self._counts)


def session_config(config: BusConfig) -> zenoh.Config:
    """Return the Zenoh configuration of a session.

    It is handed over as one document: nested keys such as `connect/retry` are refused one by one.

    Raises:
        BusError: it is not usable.
        ConfigError: certificates are missing.
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
            # of the new one seconds late. It is given up and started over instead; Zenoh's own limit is 10 s.
            "unicast": {"open_timeout": 1500},
            "link": {
                # A frozen process is noticed in 2 s instead of 10.
                "tx": {"lease": 2000},
                # Without it one message may take 1 GiB of every process that hears it.
                "rx": {"max_message_size": MAX_MESSAGE_BYTES},
            },
        },
    }
    if config.mode == "router":
        document["low_pass_filter"] = _size_limits()
    elif config.namespace:
        document["namespace"] = config.namespace
    if config.tls:
        document["transport"]["link"]["tls"] = _tls(config)
        if config.mode == "router":
            document["access_control"] = access_control(load_roles(Path(config.keys)).holders, config.namespace)
    try:
        return zenoh.Config.from_json5(json.dumps(document))
    except zenoh.ZError as error:
        raise BusError(f"[bus] in rig.toml is not a usable Zenoh configuration: {plain_reason(error)}") from error


def _tls(config: BusConfig) -> dict[str, Any]:
    """Return the certificates: both sides show one."""
    is_router = config.mode == "router"
    files = credentials(Path(config.keys), ROUTER if is_router else config.identity)
    side = "listen" if is_router else "connect"
    return {
        "root_ca_certificate": str(files.authority),
        "enable_mtls": True,
        "verify_name_on_connect": True,
        f"{side}_certificate": str(files.certificate),
        f"{side}_private_key": str(files.key),
    }


def _size_limits() -> list[dict[str, Any]]:
    """Return what the router keeps from everybody: samples and questions that are too large to be any of ours."""
    limits = {"samples": (["put"], MAX_SAMPLE_BYTES), "questions": (["query"], MAX_QUESTION_BYTES)}
    return [
        {
            "id": name,
            "flows": ["ingress"],
            "messages": messages,
            "key_exprs": ["**", "**/@pictures/**"],
            "size_limit": size,
        }
        for name, (messages, size) in limits.items()
    ]


def plain_reason(error: zenoh.ZError) -> str:
    """Return Zenoh's words without the places in its own source code."""
    return re.sub(r"( at \S+\.rs:\d+\.?|[\[\]])", "", str(error)).strip()
