"""Publishes a camera's frames for recording."""

from __future__ import annotations

from functools import partial

from rhot.arrays import ImageArray
from rhot.bus import Bus
from rhot.recording.camera_picture import CameraPicture, jpeg_of
from rhot.recording.picture_stream import PictureStream
from rhot_capture.sources import Frame


class FrameStream(PictureStream):
    """Publishes one camera's frames after detection."""

    def __init__(self, camera: str, bus: Bus) -> None:
        """Declare `rhot/@pictures/<camera>`."""
        super().__init__(camera, bus)
        self._name = camera

    def offer(self, frame: Frame, t_first_row_ns: int) -> None:
        """Send a frame if there is a subscriber; does not block.

        Args:
            frame: its image is copied.
            t_first_row_ns: start of the first row's exposure, rig clock.
        """
        self.submit(
            lambda: partial(
                self._coded, frame.image.copy(), t_first_row_ns, frame.index, frame.exposure_s, frame.readout_s
            )
        )

    def _coded(self, image: ImageArray, t_ns: int, index: int, exposure_s: float, readout_s: float) -> CameraPicture:
        return CameraPicture(
            t_ns=t_ns,
            camera=self._name,
            frame=index,
            exposure_s=exposure_s,
            readout_s=readout_s,
            jpeg=jpeg_of(image),
        )
