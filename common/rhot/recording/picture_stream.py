"""Frames to whoever records them: coded only while somebody listens, and never at the tracking's cost.

A thread of its own codes and sends. Where it does not keep up, pictures are dropped and counted.
"""

from __future__ import annotations

import logging
import threading
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import Final

import cv2

from rhot.bus import Bus, Publisher
from rhot.errors import BusError
from rhot.messages import MAX_PAYLOAD_BYTES
from rhot.recording.camera_picture import PICTURES_KEY, CameraPicture

_MOST_WAITING: Final = 8
"""Frames that may wait to be coded: an eighth of a second, 7 MB of 640x480."""

logger = logging.getLogger(__name__)


class PictureStream:
    """Sends one camera's frames.

    Attributes:
        dropped: frames that were to be sent and were not.
    """

    def __init__(self, camera: str, bus: Bus) -> None:
        """Declare `rhot/@pictures/<camera>`."""
        self.dropped = 0
        self._camera = camera
        self._publisher: Publisher[CameraPicture] = bus.publisher(f"{PICTURES_KEY}/{camera}", CameraPicture, bulk=True)
        self._worker = ThreadPoolExecutor(1, thread_name_prefix="pictures")
        self._room = threading.BoundedSemaphore(_MOST_WAITING)
        self._told = False

    @property
    def has_reader(self) -> bool:
        """Whether somebody records."""
        return self._publisher.has_reader

    def submit(self, copy: Callable[[], Callable[[], CameraPicture]]) -> None:
        """Send a frame if somebody listens; returns at once.

        Args:
            copy: called here, only when the frame will be sent: copies what the camera may overwrite, and returns what
                codes the picture, which is called on another thread.
        """
        if not self.has_reader:
            return
        if not self._room.acquire(blocking=False):
            self.dropped += 1
            return
        self._worker.submit(self._send, copy())

    def _send(self, coded: Callable[[], CameraPicture]) -> None:
        try:
            picture = coded()
            size = len(picture.jpeg) + len(picture.depth_png or b"")
            envelope_bytes = 4096
            if size > MAX_PAYLOAD_BYTES - envelope_bytes:
                raise BusError(f"a picture of {size} bytes is over the limit of {MAX_PAYLOAD_BYTES}")
            self._publisher.put(picture)
        except (BusError, cv2.error) as error:
            self.dropped += 1
            if not self._told:
                self._told = True
                logger.warning("camera %s: pictures are not sent: %s", self._camera, error)
        finally:
            self._room.release()
