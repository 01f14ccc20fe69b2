"""Parts of a picture, classified together.

Each part may hold one marker. They are laid one below the other, so that it takes one call of each kind to tell the
colours of all of them, wherever in the picture they are, and what lies between them costs nothing.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final, NamedTuple

import cv2
import numpy as np

from rhot_capture.color_table import ColorTable, ImageArray

_GAP_PX: Final = 2
"""Between parts, so that no outline runs from one into the next."""


class Region(NamedTuple):
    """Part of a picture, pixels; right and bottom are not part of it."""

    left: int
    top: int
    right: int
    bottom: int


class Cutout(NamedTuple):
    """A region in which a marker is looked for.

    Attributes:
        label: of the marker, from 1.
        region: in the picture.
        row: of the region's first row among the cutouts; its first column is 0.
    """

    label: int
    region: Region
    row: int


class Cutouts:
    """Regions of a picture one below the other.

    Attributes:
        places: the regions, from top to bottom.
        labels: (H, W) uint8, label of every pixel.
        own: (H, W) uint8, 1 where a pixel has the label that is looked for there.
        packed: (H, W, 1) uint16, 5-6-5 colours.
    """

    def __init__(self, image: ImageArray, table: ColorTable, looks: Sequence[tuple[int, Region]]) -> None:
        """Cut out and classify.

        Args:
            image: (H, W, 3) uint8 BGR.
            table: colours of the labels.
            looks: label and region of each part, at least one.
        """
        self.places: list[Cutout] = []
        row = width = 0
        for label, region in looks:
            self.places.append(Cutout(label, region, row))
            row += region.bottom - region.top + _GAP_PX
            width = max(width, region.right - region.left)
        pixels: ImageArray = np.zeros((row, width + _GAP_PX, 3), np.uint8)
        if table.labels[0] != 0:
            pixels[:] = _nobodys_color(table)
        wanted: ImageArray = np.empty((row, 1), np.uint8)
        for label, (left, top, right, bottom), row in self.places:
            end = row + bottom - top
            pixels[row:end, : right - left] = image[top:bottom, left:right]
            wanted[row : end + _GAP_PX] = label
        labels, self.packed = table.classify(pixels)
        # Single wrong pixels go; a label wins a pixel only where its neighbours carry it too.
        self.labels: ImageArray = np.asarray(cv2.medianBlur(labels, 3), dtype=np.uint8)
        self.own: ImageArray = np.equal(self.labels, wanted).view(np.uint8)


def _nobodys_color(table: ColorTable) -> tuple[int, int, int]:
    """Return a colour without a label, blue, green, red; black where every colour has one."""
    packed = int(np.argmin(table.labels))
    return ((packed & 31) << 3, ((packed >> 5) & 63) << 2, (packed >> 11) << 3)
