"""Frames to whoever records them: coded only while somebody listens, and never at the markers' cost.

A thread of its own codes and sends what was looked at for markers. Where it does not keep up, pictures are dropped and
counted. JPEG with full colour resolution: halved, as is usual, the colours of small markers would run into the desk.
"""

from __future__ import annotations

import logging
import threading
from concurrent.futures import ThreadPoolExecutor
from typing import Final

import cv2

from rhot.bus import Bus, Publisher
from rhot.errors import BusError
from rhot.messages import MAX_PAYLOAD_BYTES
from rhot.recording.camera_picture import PICTURES_KEY, CameraPicture
from rhot_capture.detection.color_table import ImageArray
from rhot_capture.preview import jpeg_of
from rhot_capture.sources import Frame

_MOST_WAITING: Final = 8
"""Frames that may wait to be coded: an eighth of a second, 7 MB of 640x480."""
_ENVELOPE_BYTES: Final = 4096

logger = logging.getLogger(__name__)


class FrameStream:
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

    def offer(self, frame: Frame, t_first_row_ns: int) -> None:
        """Send a frame if somebody listens; returns at once.

        Args:
            frame: its image is copied.
            t_first_row_ns: start of the first row's exposure, rig clock.
        """
        if not self._publisher.has_reader:
            return
        if not self._room.acquire(blocking=False):
            self.dropped += 1
            return
        picture = (frame.image.copy(), t_first_row_ns, frame.index, frame.exposure_s, frame.readout_s)
        self._worker.submit(self._send, *picture)

    def _send(self, image: ImageArray, t_ns: int, index: int, exposure_s: float, readout_s: float) -> None:
        try:
            jpeg = jpeg_of(image)
            if len(jpeg) > MAX_PAYLOAD_BYTES - _ENVELOPE_BYTES:
                raise BusError(f"a picture of {len(jpeg)} bytes is over the limit of {MAX_PAYLOAD_BYTES}")
            self._publisher.put(
                CameraPicture(
                    t_ns=t_ns,
                    camera=self._camera,
                    frame=index,
                    exposure_s=exposure_s,
                    readout_s=readout_s,
                    jpeg=jpeg,
                )
            )
        except (BusError, cv2.error) as error:
            self.dropped += 1
            if not self._told:
                self._told = True
                logger.warning("camera %s: pictures are not sent: %s", self._camera, error)
        finally:
            self._room.release()
