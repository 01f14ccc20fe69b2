"""Reading one picture file of a recording or of a calibration."""

from __future__ import annotations

from pathlib import Path
from typing import Any, Final

import cv2
import numpy as np
from numpy.typing import NDArray

from rhot.atomic_file import why_unread
from rhot.errors import ConfigError

_JPEG_START: Final = b"\xff\xd8"
_JPEG_END: Final = b"\xff\xd9"
"""Start and end of an image (ITU T.81, B.1.1.3). The end cannot occur inside of coded data, where a zero follows each
0xff."""


def read_picture(file: Path, flags: int = cv2.IMREAD_COLOR) -> NDArray[Any]:
    """Return the pixels of a picture file.

    Args:
        file: JPEG, PNG or what else OpenCV reads.
        flags: as `cv2.imdecode` takes them; by default the result is (H, W, 3) uint8, BGR.

    Raises:
        ConfigError: it cannot be read, is cut off, or is no picture.
    """
    try:
        data = file.read_bytes()
    except OSError as error:
        raise ConfigError(f"{file}: cannot be read: {why_unread(error)}") from error
    # The decoder would fill the rest with grey and go on.
    if data.startswith(_JPEG_START) and _JPEG_END not in data:
        raise ConfigError(f"{file}: the picture is cut off; copy it again, or remove it with its row of times")
    image = cv2.imdecode(np.frombuffer(data, np.uint8), flags) if data else None
    if image is None:
        raise ConfigError(f"{file}: empty, damaged or no picture (JPEG or PNG)")
    return image
