"""A thread that reads a depth camera and keeps the newest picture only; who is late finds it and never a backlog."""

from __future__ import annotations

import asyncio
import logging
import threading
import time
from typing import Final

from rhot.errors import DeviceError, RhotError
from rhot_feet.frames import DepthFrame, DepthSource

_LOG = logging.getLogger(__name__)

_READ_S: Final = 0.5
_JOIN_S: Final = 1.0


class DepthGrabber:
    """Opens a source, reads it on its own thread and hands the newest picture to one reader in an event loop.

    Attributes:
        late: pictures that were replaced by a newer one before anybody took them.
        missed: pictures that never arrived, by gaps in the source's counter.
        busy_s: processor time of the thread: the driver's work and, in a simulation, the drawing.
    """

    def __init__(self, source: DepthSource) -> None:
        self._source = source
        self._lock = threading.Lock()
        self._stopping = threading.Event()
        self._frame: DepthFrame | None = None
        self._error: Exception | None = None
        self._ended = False
        self._last_index: int | None = None
        self._wake = asyncio.Event()
        self._loop: asyncio.AbstractEventLoop | None = None
        self._thread: threading.Thread | None = None
        self.late = 0
        self.missed = 0
        self.busy_s = 0.0

    def start(self, start_ns: int) -> None:
        """Open the source on the thread and read it; call it inside the event loop that will take the pictures."""
        self._loop = asyncio.get_running_loop()
        self._thread = threading.Thread(target=self._run, args=(start_ns,), name="grab-depth", daemon=True)
        self._thread.start()

    async def next_frame(self) -> DepthFrame | None:
        """Wait for a picture that was not taken yet and return the newest; None when there are no more.

        Raises:
            RhotError: what the source raised; a foreign error comes as DeviceError.
        """
        while True:
            # Cleared before the slot is looked at: a picture that arrives in between sets it again.
            self._wake.clear()
            with self._lock:
                frame, self._frame = self._frame, None
                error, ended = self._error, self._ended
            if frame is not None:
                return frame
            if error is not None:
                if isinstance(error, RhotError):
                    raise error
                raise DeviceError(f"depth camera: {type(error).__name__}: {error}") from error
            if ended:
                return None
            await self._wake.wait()

    async def stop(self) -> None:
        """Stop the thread and close the source; returns within about a second even when a driver hangs."""
        self._stopping.set()
        await asyncio.to_thread(self._source.close)
        thread = self._thread
        if thread is not None:
            await asyncio.to_thread(thread.join, _JOIN_S)
            if thread.is_alive():
                _LOG.warning("depth camera: its driver does not return; left behind")

    def _run(self, start_ns: int) -> None:
        try:
            self._source.open(start_ns)
            while not (self._stopping.is_set() or self._source.finished):
                frame = self._source.read(_READ_S)
                self.busy_s = time.thread_time()
                if frame is not None:
                    self._store(frame)
        except Exception as error:
            with self._lock:
                self._error = error
        finally:
            with self._lock:
                self._ended = True
            self._notify()

    def _store(self, frame: DepthFrame) -> None:
        with self._lock:
            if self._last_index is not None:
                self.missed += max(0, frame.index - self._last_index - 1)
            self._last_index = frame.index
            self.late += self._frame is not None
            self._frame = frame
        self._notify()

    def _notify(self) -> None:
        if self._loop is None:
            return
        try:
            self._loop.call_soon_threadsafe(self._wake.set)
        except RuntimeError:
            # The loop closed while the driver was still reading; nobody is left to be told.
            self._stopping.set()
