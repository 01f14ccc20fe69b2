"""The newest picture of a depth camera; see `rhot.service.grabber`."""

from __future__ import annotations

import time
from collections.abc import Iterator
from typing import Final

from rhot.service.grabber import Grabber
from rhot_feet.frames import DepthFrame, DepthSource

_READ_S: Final = 0.5


class DepthGrabber(Grabber[DepthFrame]):
    """Opens a source and reads it on its own thread.

    Attributes:
        busy_s: processor time of the thread: the driver's work and, in a simulation, the drawing.
    """

    def __init__(self, source: DepthSource, start_ns: int) -> None:
        """Prepare to open a source at a time, rig clock."""
        super().__init__("depth camera", self._read, source.close)
        self._source = source
        self._start_ns = start_ns
        self.busy_s = 0.0

    def _read(self) -> Iterator[DepthFrame | None]:
        self._source.open(self._start_ns)
        while not self._source.finished:
            frame = self._source.read(_READ_S)
            self.busy_s = time.thread_time()
            yield frame
            del frame
