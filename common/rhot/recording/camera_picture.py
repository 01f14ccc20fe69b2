"""Pictures on the bus, from the camera nodes to who records them."""

from __future__ import annotations

from typing import Annotated, Final

import cv2
import numpy as np
from numpy.typing import NDArray
from pydantic import ConfigDict, Field

from rhot.messages import Count, Message, Name
from rhot.messages.base import WireModel

PICTURES_KEY: Final = "rhot/@pictures"
"""Cameras publish below this. Wildcards such as `rhot/**` do not take in a chunk that begins with @: whoever watches or
records everything gets no pictures, and nobody codes any, unless they are asked for by name."""

_QUALITY: Final = 90
"""Of simulated noisy pictures it moves marker centres by 0.08 px (root mean square; 95: 0.06, 75: 0.13; 0.19 at half
colour resolution) and takes 54 kB (114, 20), 26 Mbit/s at 60 Hz."""
_JPEG: Final = (
    cv2.IMWRITE_JPEG_QUALITY,
    _QUALITY,
    cv2.IMWRITE_JPEG_SAMPLING_FACTOR,
    cv2.IMWRITE_JPEG_SAMPLING_FACTOR_444,
)
_PNG: Final = (cv2.IMWRITE_PNG_COMPRESSION, 1, cv2.IMWRITE_PNG_FILTER, cv2.IMWRITE_PNG_FILTER_SUB)
"""Of simulated depth of 848x480: 4.9 ms and 130 kB; with OpenCV's own choice of filters 8.2 ms and 95 kB."""

_Row = tuple[float, float, float]


class Lens(WireModel):
    """The lens of a camera that knows it by itself.

    Attributes:
        width, height: pixels.
        K: 3x3 intrinsics, pixels.
        distortion: OpenCV's coefficients; empty = none.
    """

    width: Annotated[int, Field(gt=0, le=1 << 14)]
    height: Annotated[int, Field(gt=0, le=1 << 14)]
    K: tuple[_Row, _Row, _Row]
    distortion: Annotated[tuple[float, ...], Field(max_length=14)] = ()


class CameraPicture(Message):
    """One frame of a camera that was looked at for markers.

    Attributes:
        t_ns: start of the first row's exposure, rig clock; of a depth camera the middle of the exposure.
        camera: name of the camera as in `rig.toml`, `feet` for the feet's depth camera.
        frame: the source's frame counter.
        exposure_s: exposure time of each row; 0 where `t_ns` is its middle.
        readout_s: time between the read-out of the first and of the last row.
        jpeg: the picture.
        lens: of a depth camera.
        depth_png: (H, W) uint16, millimetres along the optical axis, aligned to the picture, 0 = none; absent where the
            camera gave no depth.
    """

    model_config = ConfigDict(ser_json_bytes="base64", val_json_bytes="base64")

    camera: Name
    frame: Count
    exposure_s: Annotated[float, Field(ge=0.0, le=10.0)]
    readout_s: Annotated[float, Field(ge=0.0, le=10.0)]
    jpeg: bytes
    lens: Lens | None = None
    depth_png: bytes | None = None


def jpeg_of(image: NDArray[np.uint8]) -> bytes:
    """Return a frame (H, W, 3), uint8 BGR, as it is recorded: JPEG with full colour resolution.

    Halved, as is usual, the colours of small markers would run into the desk.
    """
    _, data = cv2.imencode(".jpg", image, _JPEG)
    return bytes(data)


def png_of(depth_mm: NDArray[np.uint16]) -> bytes:
    """Return a depth image (H, W), uint16, as it is recorded: PNG, without loss."""
    _, data = cv2.imencode(".png", depth_mm, _PNG)
    return bytes(data)
