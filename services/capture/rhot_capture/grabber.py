"""The newest frame of a capture source; see `rhot.service.grabber`."""

from __future__ import annotations

from rhot.service.grabber import Grabber
from rhot_capture.sources.frame import Frame, Source


def grab(source: Source, name: str = "camera") -> Grabber[Frame]:
    """Return a grabber of an opened source, which from its start on is read on the grabber's thread only.

    Args:
        source: to read.
        name: of the camera, for messages.
    """
    return Grabber(f"camera {name}", lambda: iter(source.read, None), source.close)
