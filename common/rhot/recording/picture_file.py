"""Reading one picture of a recording or of a calibration.

Pixels are those of the sensor, row by row as it was exposed. Whatever a file says of its orientation (EXIF) is ignored,
in calibration as in tracking: a lens belongs to the sensor, and so do the times of its rows.
"""

from __future__ import annotations

import stat
from pathlib import Path
from typing import Any, Final

import cv2
import numpy as np
from numpy.typing import NDArray

from rhot.atomic_file import why_unread
from rhot.errors import ConfigError

_START_AND_END: Final = ((b"\xff\xd8", b"\xff\xd9"), (b"\x89PNG", b"IEND"))
"""Of an image: JPEG (ITU T.81, B.1.1.3), PNG. A JPEG's end cannot occur inside of coded data, where a zero follows each
0xff, but at the end of a thumbnail in front of them."""


def read_picture(file: Path, flags: int = cv2.IMREAD_COLOR) -> NDArray[Any]:
    """Return the pixels of a picture file.

    Args:
        file: JPEG, PNG or what else OpenCV reads.
        flags: as `cv2.imdecode` takes them; by default the result is (H, W, 3) uint8, BGR.

    Raises:
        ConfigError: it cannot be read, is cut off, or is no picture.
    """
    try:
        # Whoever opens a named pipe waits for its writer.
        data = file.read_bytes() if stat.S_ISREG(file.stat().st_mode) else b""
    except OSError as error:
        raise ConfigError(f"{file}: cannot be read: {why_unread(error)}") from error
    # The decoder would fill the rest with grey and go on.
    # Some programs append data of their own.
    if any(data.startswith(start) and end not in data[-4096:] for start, end in _START_AND_END):
        raise ConfigError(f"{file}: the picture is cut off; copy it again, or remove it with its row of times")
    image = decode_picture(data, flags)
    if image is None:
        raise ConfigError(f"{file}: empty, damaged or no picture (JPEG, PNG, BMP or TIFF)")
    return image


def open_video(file: Path) -> cv2.VideoCapture:
    """Return an opened video whose frames are the sensor's rows; ask it whether it `isOpened`."""
    capture = cv2.VideoCapture(str(file))
    capture.set(cv2.CAP_PROP_ORIENTATION_AUTO, 0)
    return capture


def decode_picture(data: bytes, flags: int = cv2.IMREAD_COLOR) -> NDArray[Any] | None:
    """Return the pixels of a packed picture, `flags` as for `read_picture`; None where it is empty, damaged or none."""
    if not data:
        return None
    try:
        # IMREAD_UNCHANGED (−1) stays as it is: all of its bits are set.
        return cv2.imdecode(np.frombuffer(data, np.uint8), flags | cv2.IMREAD_IGNORE_ORIENTATION)
    except cv2.error:
        # OpenCV refuses pictures of more than 2^30 pixels in this way.
        return None
