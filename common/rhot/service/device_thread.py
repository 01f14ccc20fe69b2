"""Calls into a driver, each with a deadline, on a thread that a hung driver cannot make the process wait for.

A thread cannot be cancelled, so a call that does not return takes its thread, and often the device, with it. asyncio's
own threads are joined when the process ends; this one is a daemon and is left behind.
"""

from __future__ import annotations

import asyncio
import queue
import threading
from collections.abc import Callable
from concurrent.futures import Future
from typing import Any, Final, TypeVar

from rhot.errors import DeviceError, HungDeviceError, RhotError

T = TypeVar("T")

CLOSE_LIMIT_S: Final = 3.0
"""So long may a driver take to let go of its device: a picamera2 that works needs the frame in flight and libcamera's
own timer of 1 s (picamera2 issue 1264). Below the 5 s of `TimeoutStopSec` of the units."""
OPEN_LIMIT_S: Final = 20.0
"""So long may a driver take to open a device: libcamera loads its tuning in 1–2 s on a Pi 3, SteamVR takes some seconds
to answer while it starts."""


class DeviceThread:
    """One thread on which the calls into one driver run, one after the other."""

    def __init__(self, name: str) -> None:
        """Name the device, for messages; the thread starts with the first call."""
        self._name = name
        self._jobs: queue.SimpleQueue[tuple[Future[Any], Callable[[], Any]] | None] = queue.SimpleQueue()
        self._thread: threading.Thread | None = None
        self._hung: HungDeviceError | None = None

    async def call(self, what: str, function: Callable[[], T], limit_s: float) -> T:
        """Run a function on the thread, after those before it, and return its result.

        Args:
            what: is called, for messages, such as `close`.
            function: the call into the driver.
            limit_s: longest wait.

        Raises:
            RhotError: what the function raised; a foreign exception comes as DeviceError.
            HungDeviceError: it did not return in time.
        """
        if self._hung is not None:
            # What hangs stays first in the queue: nothing behind it will run.
            raise self._hung
        if self._thread is None:
            self._thread = threading.Thread(target=self._run, name=f"device {self._name}", daemon=True)
            self._thread.start()
        future: Future[T] = Future()
        self._jobs.put((future, function))
        done = asyncio.wrap_future(future)
        # A task that is cancelled leaves the call to its thread; nobody asks for its error then.
        done.add_done_callback(lambda ended: ended.cancelled() or ended.exception())
        await asyncio.wait((done,), timeout=limit_s)
        if not done.done():
            self._hung = hung(self._name, what, limit_s)
            raise self._hung
        try:
            return done.result()
        except RhotError:
            raise
        except Exception as error:
            raise DeviceError(f"{self._name}: {what}: {type(error).__name__}: {error}") from error

    def end(self) -> None:
        """End the thread after the calls that it was given."""
        self._jobs.put(None)

    def _run(self) -> None:
        while (job := self._jobs.get()) is not None:
            future, function = job
            if not future.set_running_or_notify_cancel():
                continue
            try:
                result = function()
            except BaseException as error:  # whatever it is, whoever waits must hear of it
                future.set_exception(error)
            else:
                future.set_result(result)
            del job, future, function


def hung(name: str, what: str, limit_s: float) -> HungDeviceError:
    """Return the error of a driver that does not return."""
    return HungDeviceError(
        f"{name}: {what}: its driver has not returned for {limit_s:g} s and holds the device; this process "
        "ends, and systemd or `rhot up` restarts it (started by hand: start it again). If it comes back again and "
        "again, unplug the device or restart this machine"
    )
