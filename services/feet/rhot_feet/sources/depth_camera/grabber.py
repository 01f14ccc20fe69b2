"""The newest picture of a depth camera; see `rhot.service.grabber`."""

from __future__ import annotations

import time
from collections.abc import Iterator

from rhot.service.grabber import Grabber
from rhot_feet.frames import DepthFrame, DepthSource


class DepthGrabber(Grabber[DepthFrame]):
    """Reads an opened source on its own thread.

    Attributes:
        busy_s: processor time of the thread: the driver's work and, in a simulation, the drawing.
    """

    def __init__(self, source: DepthSource) -> None:
        """Prepare to read a source; `open` opens it."""
        super().__init__("depth camera", self._read, source.close)
        self._source = source
        self.busy_s = 0.0

    def _read(self) -> Iterator[DepthFrame | None]:
        while not self._source.finished:
            read_s = 0.5
            frame = self._source.read(read_s)
            self.busy_s = time.thread_time()
            yield frame
            del frame
