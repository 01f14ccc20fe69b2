"""Publishes the inputs of feet tracking for recording: images with depth, and the ankles' samples.

Both are encoded only while there is a subscriber.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import replace
from functools import partial
from typing import Final

import numpy as np
from numpy.typing import NDArray

from rhot.bus import Bus, Publisher
from rhot.messages import Side
from rhot.recording.camera_picture import CameraPicture, Lens, jpeg_of, png_of
from rhot.recording.feet_tables import MOST_SAMPLES, SENSORS_KEY, SensorSamples
from rhot.recording.picture_folder import PictureStream
from rhot.rig.calibration import matrix3
from rhot_feet.frames import DepthFrame
from rhot_feet.imu.samples import ImuSamples

CAMERA: Final = "feet"
"""Name of the depth camera on the bus and in recordings."""


class InputStream(PictureStream):
    """Sends the depth camera's frames and the ankles' samples."""

    def __init__(self, bus: Bus, sides: Iterable[Side]) -> None:
        """Declare `rhot/@pictures/feet` and `rhot/@sensors/<side>`."""
        super().__init__(CAMERA, bus)
        self._sensors: dict[Side, Publisher[SensorSamples]] = {
            side: bus.publisher(f"{SENSORS_KEY}/{side}", SensorSamples) for side in sides
        }

    def offer(self, frame: DepthFrame) -> None:
        """Send a frame if somebody listens; its images are copied, because a camera may write over them."""

        def copy() -> partial[CameraPicture]:
            depth_mm = None if frame.depth_mm is None else frame.depth_mm.copy()
            return partial(picture_of, replace(frame, color=frame.color.copy(), depth_mm=depth_mm))

        self.submit(copy)

    def offer_samples(self, side: Side, samples: ImuSamples) -> None:
        """Send an ankle's samples if somebody listens."""
        publisher = self._sensors[side]
        if publisher.has_reader:
            for message in samples_of(side, samples):
                publisher.put(message)


def picture_of(frame: DepthFrame) -> CameraPicture:
    """Return a frame as it is recorded; coding takes some milliseconds."""
    camera = frame.camera
    return CameraPicture(
        t_ns=frame.t_ns,
        camera=CAMERA,
        frame=frame.index,
        exposure_s=0.0,
        readout_s=0.0,
        jpeg=jpeg_of(frame.color),
        lens=Lens(
            width=camera.width,
            height=camera.height,
            K=matrix3(camera.K),
            distortion=tuple(np.ravel(camera.distortion).tolist()),
        ),
        depth_png=None if frame.depth_mm is None else png_of(frame.depth_mm),
    )


def samples_of(side: Side, samples: ImuSamples) -> Iterator[SensorSamples]:
    """Yield an ankle's samples as messages of at most `MOST_SAMPLES`."""
    for first in range(0, len(samples), MOST_SAMPLES):
        part = samples.rows(first, first + MOST_SAMPLES)
        yield SensorSamples(
            t_ns=int(part.t_ns[0]),
            side=side,
            times_ns=tuple(part.t_ns.tolist()),
            specific_force=_vectors(part.specific_force),
            angular_rate=_vectors(part.angular_rate),
            orientation=tuple((x, y, z, w) for x, y, z, w in part.orientation_xyzw.tolist()),
        )


def _vectors(values: NDArray[np.float64]) -> tuple[tuple[float, float, float], ...]:
    return tuple((x, y, z) for x, y, z in values.tolist())
