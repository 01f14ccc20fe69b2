"""A thread that reads a camera and keeps the newest frame only.

A reader that is late finds the newest frame and a count of those it missed; it never works through a backlog.
"""

from __future__ import annotations

import asyncio
import logging
import threading
import time
from collections.abc import Callable, Iterator
from concurrent.futures import Future
from dataclasses import dataclass
from typing import Final, Generic, Protocol, TypeVar

from rhot.errors import DeviceError, RhotError
from rhot.service.device_thread import CLOSE_LIMIT_S, OPEN_LIMIT_S, DeviceThread, hung

_LOG = logging.getLogger(__name__)
_LOOK_S: Final = 0.01


class Numbered(Protocol):
    """A frame that knows its number in the source's own counting."""

    @property
    def index(self) -> int:
        """The source's counter; a gap means lost frames."""
        ...


F = TypeVar("F", bound=Numbered)


@dataclass(frozen=True, slots=True)
class GrabberCounts:
    """What a grabber did since it started.

    Attributes:
        read: frames that the source delivered.
        dropped_late: frames replaced by a newer one before anybody took them.
        missed: frames that the source itself never delivered, by gaps in its counter.
    """

    read: int = 0
    dropped_late: int = 0
    missed: int = 0


class Grabber(Generic[F]):
    """Reads frames on its own thread and hands the newest to one reader: in an event loop, or on a thread (`work`)."""

    def __init__(self, name: str, frames: Callable[[], Iterator[F | None]], close: Callable[[], None]) -> None:
        """Prepare; `start` begins to read.

        Args:
            name: for the thread and for messages, such as `camera left`.
            frames: called once; iterated on the grabber's thread; yields frames, None where there is none yet, and ends
                when there are no more.
            close: ends a read that is under way and lets go of the device; called when the grabber is stopped, on a
                thread of its own.
        """
        self._name = name
        self._frames = frames
        self._close = close
        self._changed = threading.Condition(threading.Lock())
        self._stopping = threading.Event()
        self._frame: F | None = None
        self._error: Exception | None = None
        self._ended = False
        self._counts = GrabberCounts()
        self._last_index: int | None = None
        self._wake: asyncio.Event | None = None
        self._loop: asyncio.AbstractEventLoop | None = None
        self._thread: threading.Thread | None = None
        self._worker: threading.Thread | None = None
        # Opening and closing, one after the other even when the session ends during the opening.
        self._device = DeviceThread(name)

    @property
    def counts(self) -> GrabberCounts:
        """Counts so far; may be read from any thread."""
        with self._changed:
            return self._counts

    async def open(self, function: Callable[[], None], limit_s: float = OPEN_LIMIT_S) -> None:
        """Open the device by a call that may take some time, off the event loop; `stop` waits for it.

        Raises:
            RhotError: what the call raised; a foreign error comes as DeviceError.
            HungDeviceError: the driver has not returned within `limit_s`.
        """
        await self._device.call("open", function, limit_s)

    def start(self) -> None:
        """Start the thread; call it inside the event loop that will read."""
        self._loop = asyncio.get_running_loop()
        self._wake = asyncio.Event()
        self._thread = threading.Thread(target=self._run, name=f"grab {self._name}", daemon=True)
        self._thread.start()

    async def next_frame(self) -> F | None:
        """Wait for a frame that was not taken yet and return the newest; None when the source has ended.

        Raises:
            RhotError: what the source raised; a foreign error comes as DeviceError.
        """
        if self._wake is None:
            raise DeviceError(f"{self._name}: the grabber was not started")
        while True:
            # Cleared before the slot is looked at: a frame that arrives in between sets it again.
            self._wake.clear()
            with self._changed:
                frame, ended = self._take()
            if frame is not None or ended:
                return frame
            await self._wake.wait()

    async def work(self, function: Callable[[F], None]) -> None:
        """Call a function with the newest frame, on a thread of its own, until the source has ended or is stopped.

        A frame meets no event loop on its way: waking a thread costs 0.2 ms on a busy machine, and now and then a time
        slice of whatever else runs there. `stop` waits for the frame in work.

        Raises:
            RhotError: as `next_frame`; or what the function raised.
        """
        done: Future[None] = Future()
        done.set_running_or_notify_cancel()  # a task that is cancelled leaves the thread to `stop`
        self._worker = threading.Thread(
            target=self._work, args=(function, done), name=f"work {self._name}", daemon=True
        )
        self._worker.start()
        await asyncio.wrap_future(done)

    async def stop(self, limit_s: float = CLOSE_LIMIT_S) -> None:
        """Stop reading and close the source.

        Args:
            limit_s: longest wait for the driver, for closing and for the end of the last read together.

        Raises:
            HungDeviceError: the driver has not returned by then; the device is free again only after this process.
        """
        begun = time.monotonic()
        with self._changed:
            self._stopping.set()
            self._changed.notify_all()
        # The frame in work may lie in the device's memory.
        await _ended(self._worker, begun + limit_s)
        try:
            await self._device.call("close", self._close, limit_s)
        except DeviceError as error:
            # What cannot be closed, such as a camera that was pulled out, is closed.
            _LOG.warning("%s", error)
        finally:
            self._device.end()
            with self._changed:
                self._frame = None
                self._ended = True
            self._notify()
        if not await _ended(self._thread, begun + limit_s):
            raise hung(self._name, "read", limit_s)

    def _take(self) -> tuple[F | None, bool]:
        """Return the newest frame, None where there is none, and whether no more will come; the lock is held.

        Raises:
            RhotError: as `next_frame`.
        """
        frame, self._frame = self._frame, None
        if frame is None and self._error is not None:
            if isinstance(self._error, RhotError):
                raise self._error
            raise DeviceError(f"{self._name}: {type(self._error).__name__}: {self._error}") from self._error
        return frame, self._ended

    def _work(self, function: Callable[[F], None], done: Future[None]) -> None:
        try:
            while (frame := self._next()) is not None:
                function(frame)
                # Released before the wait for the next frame, because it may occupy one of the camera's buffers.
                del frame
        except BaseException as error:  # whatever it is, whoever waits must hear of it
            done.set_exception(error)
        else:
            done.set_result(None)

    def _next(self) -> F | None:
        with self._changed:
            while not self._stopping.is_set():
                frame, ended = self._take()
                if frame is not None or ended:
                    return frame
                self._changed.wait()
        return None

    def _run(self) -> None:
        try:
            for frame in self._frames():
                if frame is not None:
                    self._store(frame)
                del frame  # else the camera's memory would stay taken during the next read
                if self._stopping.is_set():
                    break
        except Exception as error:
            with self._changed:
                self._error = error
        finally:
            with self._changed:
                self._ended = True
            self._notify()

    def _store(self, frame: F) -> None:
        with self._changed:
            counts = self._counts
            gap = 0 if self._last_index is None else max(0, frame.index - self._last_index - 1)
            self._counts = GrabberCounts(
                counts.read + 1, counts.dropped_late + (self._frame is not None), counts.missed + gap
            )
            self._last_index = frame.index
            self._frame = frame
        self._notify()

    def _notify(self) -> None:
        if self._worker is not None:
            with self._changed:
                self._changed.notify_all()
            return
        if self._loop is None or self._wake is None:
            return
        try:
            self._loop.call_soon_threadsafe(self._wake.set)
        except RuntimeError:
            # The loop closed while the driver was still reading; nobody is left to notify.
            self._stopping.set()


async def _ended(thread: threading.Thread | None, deadline_s: float) -> bool:
    """Wait for a thread until a time on the monotonic clock; return whether it has ended."""
    while thread is not None and thread.is_alive():
        if time.monotonic() > deadline_s:
            return False
        await asyncio.sleep(_LOOK_S)
    return True
