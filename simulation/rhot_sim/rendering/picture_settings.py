"""Saturation, contrast and brightness of a simulated picture, as a camera's own processor applies them.

    grey = 0.114 B + 0.587 G + 0.299 R
    C' = 127.5 + contrast · (grey + saturation · (C − grey) − 127.5) + 255 · brightness

The order is that of a Raspberry Pi's: colour matrix, then the tone curve about the middle level (libcamera,
`src/ipa/rpi/controller/rpi/contrast.cpp`). Grey is ITU-R BT.601's.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Final

import cv2
import numpy as np

from rhot_sim.rendering.backdrop import Image

_GREY_BGR: Final = np.array([0.114, 0.587, 0.299])
_MIDDLE: Final = 127.5
_RANGE: Final = 255.0


def with_picture(image: Image, picture: Mapping[str, float]) -> Image:
    """Return a picture with settings applied; a neutral setting returns the picture itself.

    Args:
        image: (H, W, 3) uint8, blue green red.
        picture: `saturation`, `contrast` and `brightness` as in `CameraConfig`.
    """
    saturation, contrast, brightness = picture["saturation"], picture["contrast"], picture["brightness"]
    if (saturation, contrast, brightness) == (1.0, 1.0, 0.0):
        return image
    colors = saturation * np.eye(3) + (1.0 - saturation) * np.tile(_GREY_BGR, (3, 1))
    offset = _MIDDLE * (1.0 - contrast) + _RANGE * brightness
    matrix = np.column_stack([contrast * colors, np.full(3, offset)])
    return np.asarray(cv2.transform(image, matrix), dtype=np.uint8)
