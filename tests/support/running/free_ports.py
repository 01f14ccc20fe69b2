"""Ports of the loopback interface that stay free until a test uses them.

A port that the kernel picks (bind to 0) can be taken by any outgoing connection between the pick and the use, since
both come from one range. So these ports lie below that range, and each test worker has a part of it to itself.
"""

from __future__ import annotations

import os
import random
import socket
from collections.abc import Iterator
from typing import Final

_RANGE: Final = range(15_000, 32_000)
"""Above the usual servers; Linux connects from 32768 on, other systems from 49152 on (ip(7), RFC 6335)."""


def free_ports() -> Iterator[int]:
    """Yield ports that no program uses, by TCP or UDP, none of them twice; for one worker of one test run."""
    worker = int(os.environ.get("PYTEST_XDIST_WORKER", "gw0").removeprefix("gw"))
    workers = int(os.environ.get("PYTEST_XDIST_WORKER_COUNT", "1"))
    share = _RANGE[worker::workers]
    # A random start: another run of the tests on this machine begins elsewhere.
    start = random.SystemRandom().randrange(len(share))
    for index in range(len(share)):
        port = share[(start + index) % len(share)]
        if _is_free(port, socket.SOCK_STREAM) and _is_free(port, socket.SOCK_DGRAM):
            yield port


def _is_free(port: int, kind: socket.SocketKind) -> bool:
    with socket.socket(type=kind) as probe:
        try:
            probe.bind(("127.0.0.1", port))
        except OSError:
            return False
        return True
