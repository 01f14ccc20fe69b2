"""How a process of ours is asked to end, and tells systemd that it is ready and alive."""

from __future__ import annotations

import asyncio
import contextlib
import os
import signal
import socket
import sys
import threading
from collections.abc import Coroutine
from dataclasses import dataclass, field
from typing import Any, Final

from rhot.errors import EXIT_AGAIN, HungDeviceError

# Telling systemd that a service is ready and alive (the sd_notify protocol); nothing outside systemd.


def notify(state: str) -> None:
    """Send a line such as `READY=1` to systemd; does nothing where nobody listens."""
    address = os.environ.get("NOTIFY_SOCKET", "")
    if address.startswith("@"):  # an abstract socket
        address = "\0" + address[1:]
    if address and sys.platform != "win32":
        # systemd may have gone away, or the socket is not ours; the service itself is well.
        with contextlib.suppress(OSError), socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as channel:
            channel.sendto(state.encode(), address)


def watchdog_interval_s() -> float | None:
    """Return how often systemd wants a sign of life (half its limit), None when it does not."""
    try:
        limit_us = int(os.environ.get("WATCHDOG_USEC", ""))
    except ValueError:
        return None
    return limit_us / 2e6 if limit_us > 0 else None


# How a process of ours is asked to end.

EXIT_WITH_PARENT: Final = "RHOT_EXIT_WITH_PARENT"
"""Set by a parent that holds the other end of standard input: when that closes, however the parent died, end too."""
_HUNG_END_S: Final = 2.0
"""From the verdict that a driver hangs to the process's end at the latest."""


@dataclass(slots=True)
class Stop:
    """Whether the process was asked to end.

    Attributes:
        requested: set by SIGINT, SIGTERM, SIGHUP or the parent's end.
        interrupted: it was Ctrl-C.
    """

    requested: asyncio.Event = field(default_factory=asyncio.Event)
    interrupted: bool = False

    @property
    def exit_code(self) -> int:
        """What the process ends with: 130 after Ctrl-C, 0 after an orderly SIGTERM."""
        return 128 + signal.SIGINT if self.interrupted else 0


def install_stop() -> Stop:
    """Catch SIGINT and SIGTERM, and the parent's end where it asked for that; the second signal ends at once.

    A terminal that is closed, or an ssh connection that ends, asks by SIGHUP, perhaps twice: from shell and kernel.
    With `nohup` it is ignored.
    """
    stop = Stop()
    loop = asyncio.get_running_loop()

    def on_signal(number: int) -> None:
        if stop.requested.is_set():
            # Asked twice: somebody is impatient, or closing hangs.
            os._exit(128 + number)
        stop.interrupted = number == signal.SIGINT
        stop.requested.set()

    for number in (signal.SIGINT, signal.SIGTERM):
        if sys.platform == "win32":  # its event loops take no handlers
            signal.signal(number, lambda number, _: loop.call_soon_threadsafe(on_signal, number))
        else:
            loop.add_signal_handler(number, on_signal, number)
    if sys.platform != "win32" and signal.getsignal(signal.SIGHUP) != signal.SIG_IGN:
        loop.add_signal_handler(signal.SIGHUP, stop.requested.set)
    if os.environ.get(EXIT_WITH_PARENT):
        _watch_parent(loop, stop.requested)
    return stop


def _watch_parent(loop: asyncio.AbstractEventLoop, stopping: asyncio.Event) -> None:
    def wait_for_end() -> None:
        with contextlib.suppress(OSError):
            while os.read(sys.stdin.fileno(), 4096):
                pass
        with contextlib.suppress(RuntimeError):  # the loop has ended meanwhile
            loop.call_soon_threadsafe(stopping.set)

    # A thread, because event loops of Windows cannot wait for a pipe that was opened elsewhere.
    threading.Thread(target=wait_for_end, name="parent", daemon=True).start()


def run_to_the_end(work: Coroutine[Any, Any, int]) -> int:
    """Run a service on a new event loop; a driver that hangs does not keep the process from ending.

    Raises:
        RhotError: as the service does.
    """

    async def main() -> int:
        try:
            return await work
        except HungDeviceError:
            # From here on everything may hang: the loop's threads, and the driver's at the interpreter's end.
            last = threading.Timer(_HUNG_END_S, os._exit, (EXIT_AGAIN,))
            last.daemon = True
            last.start()
            raise

    return asyncio.run(main())
