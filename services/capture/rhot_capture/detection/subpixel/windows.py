"""Windows of the picture that hold a blob each, and the grids on which they are measured.

As shares are linear in colour, the mean of four pixels has their mean share: a large window is measured on a coarser
grid, at the cost of a small one.
"""

from __future__ import annotations

from typing import Final, NamedTuple

import cv2
import numpy as np

from rhot.arrays import ImageArray
from rhot_capture.detection.subpixel.shares import Shares

_COARSE_FROM_PX: Final = 40
"""Width or height from which on a window is measured on a grid twice as coarse; coarser still, hardly any of the
surroundings would be left beyond the rim."""


class Window(NamedTuple):
    """A blob's window of the image.

    Attributes:
        image: (h, w, 3) uint8.
        mask: (h, w) uint8, 255 where the pixels were taken for the marker, holes filled.
        round_part: whether the paint covers something round, such as a fingertip.
        shared: whether the painted shares are asked for.
    """

    image: ImageArray
    mask: ImageArray
    round_part: bool = False
    shared: bool = True


class Centre(NamedTuple):
    """Centre of a blob.

    Attributes:
        u, v: pixels, in the coordinates of the window.
        area: painted area, square pixels.
        shares: painted share of the window's pixels; None where it was not asked for.
    """

    u: float
    v: float
    area: float
    shares: Shares | None


class Grid(NamedTuple):
    """A window as it is measured.

    Attributes:
        window: as it was given.
        scale: pixels of the window to the side of one of the grid.
        left, top: of the grid in the window, pixels.
        image: (h, w, 3) uint8, mean colours.
        mask: (h, w) uint8, 255 where at least half is inside the blob, else 0.
    """

    window: Window
    scale: int
    left: int
    top: int
    image: ImageArray
    mask: ImageArray


def grid_of(window: Window, coarse: bool = True) -> Grid:
    """Return the grid of a window.

    Args:
        window: to be measured.
        coarse: whether a large window may have a coarser grid.
    """
    height, width = window.mask.shape
    if not coarse or max(height, width) < _COARSE_FROM_PX:
        return Grid(window, 1, 0, 0, window.image, window.mask)
    # What is left over goes on a side where there is no paint.
    top = 1 if height % 2 and window.mask[-1].any() else 0
    left = 1 if width % 2 and window.mask[:, -1].any() else 0
    height, width = height // 2, width // 2
    part = slice(top, top + 2 * height), slice(left, left + 2 * width)
    image = cv2.resize(window.image[part], (width, height), interpolation=cv2.INTER_AREA)
    covered = cv2.resize(window.mask[part], (width, height), interpolation=cv2.INTER_AREA)
    _, mask = cv2.threshold(covered, 127, 255, cv2.THRESH_BINARY)
    if cv2.countNonZero(mask) == 0:
        # Lone pixels in a large window, which fill no pixel of the grid by half, are kept where they fill most.
        _, mask = cv2.threshold(covered, int(covered.max()) - 1, 255, cv2.THRESH_BINARY)
    return Grid(window, 2, left, top, np.asarray(image, dtype=np.uint8), np.asarray(mask, dtype=np.uint8))
