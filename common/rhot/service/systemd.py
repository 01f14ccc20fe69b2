"""Telling systemd that a service is ready and alive (the sd_notify protocol); nothing outside systemd."""

from __future__ import annotations

import os
import socket


def notify(state: str) -> None:
    """Send a line such as `READY=1` to systemd; does nothing where nobody listens."""
    address = os.environ.get("NOTIFY_SOCKET")
    if not address:
        return
    if address.startswith("@"):  # an abstract socket
        address = "\0" + address[1:]
    try:
        with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM | socket.SOCK_CLOEXEC) as channel:
            channel.sendto(state.encode(), address)
    except OSError:
        # systemd went away or the socket is not ours; the service itself is well.
        return


def watchdog_interval_s() -> float | None:
    """Return how often systemd wants a sign of life (half its limit), None when it does not."""
    try:
        limit_us = int(os.environ.get("WATCHDOG_USEC", ""))
    except ValueError:
        return None
    return limit_us / 2e6 if limit_us > 0 else None
