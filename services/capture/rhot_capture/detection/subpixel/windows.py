"""Windows of the image that contain a blob each, and the grids on which they are measured.

Painted shares are linear in colour, so the mean of four pixels has their mean share. Large windows are therefore
measured on a coarser grid, which saves time.
"""

from __future__ import annotations

from typing import NamedTuple

import cv2
import numpy as np

from rhot.arrays import ImageArray
from rhot_capture.detection.subpixel.shares import Shares


class Window(NamedTuple):
    """A blob's window of the image.

    Attributes:
        image: (h, w, 3) uint8.
        mask: (h, w) uint8, 255 for pixels of the marker, holes filled.
        round_part: whether the painted surface is round, such as a fingertip.
        shared: whether to return the painted shares.
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
        shares: painted shares of the window's pixels; None if they were not requested.
        skin_side: see `rhot.messages.Marker`; None without a table of skin.
        skin_share: share of the ring around the blob that is skin.
    """

    u: float
    v: float
    area: float
    shares: Shares | None
    skin_side: tuple[float, float] | None = None
    skin_share: float = 0.0


class Grid(NamedTuple):
    """Grid on which a window is measured.

    Attributes:
        window: the window.
        scale: size of a grid cell, pixels of the window.
        left, top: position of the grid in the window, pixels.
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
        coarse: whether a coarser grid may be used for a large window.
    """
    height, width = window.mask.shape
    # Width or height from which a window is measured on a grid that is twice as coarse. On a coarser one, hardly
    # any pixels of the surroundings would remain.
    if not coarse or max(height, width) < 40:
        return Grid(window, 1, 0, 0, window.image, window.mask)
    # An odd row or column is dropped on a side without paint.
    top = 1 if height % 2 and window.mask[-1].any() else 0
    left = 1 if width % 2 and window.mask[:, -1].any() else 0
    height, width = height // 2, width // 2
    part = slice(top, top + 2 * height), slice(left, left + 2 * width)
    image = cv2.resize(window.image[part], (width, height), interpolation=cv2.INTER_AREA)
    covered = cv2.resize(window.mask[part], (width, height), interpolation=cv2.INTER_AREA)
    _, mask = cv2.threshold(covered, 127, 255, cv2.THRESH_BINARY)
    if cv2.countNonZero(mask) == 0:
        # Isolated pixels that do not fill half of any cell: use the cells that they fill most.
        _, mask = cv2.threshold(covered, int(covered.max()) - 1, 255, cv2.THRESH_BINARY)
    return Grid(window, 2, left, top, np.asarray(image, dtype=np.uint8), np.asarray(mask, dtype=np.uint8))
