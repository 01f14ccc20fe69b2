"""Parts of a picture, classified together.

Each part may hold one marker. They are laid one below the other, so that it takes one call of each kind to tell the
colours of all of them, wherever in the picture they are, and what lies between them costs nothing. Of parts as small
as these a call costs more than the pixels do.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final, NamedTuple

import cv2
import numpy as np

from rhot.arrays import ImageArray
from rhot.errors import ConfigError
from rhot_capture.detection.color_table import ColorTable

_GAP_PX: Final = 2
"""Round parts, so that no outline runs from one into the next."""
_MAJORITY: Final = 5
"""Of the nine pixels in a square."""


class Region(NamedTuple):
    """Part of a picture, pixels; right and bottom are not part of it."""

    left: int
    top: int
    right: int
    bottom: int

    def overlaps(self, other: Region) -> bool:
        """Tell whether some pixel is part of both."""
        across = self.left < other.right and other.left < self.right
        return across and self.top < other.bottom and other.top < self.bottom

    def joined(self, other: Region) -> Region:
        """Return the smallest region that contains both."""
        return Region(
            min(self.left, other.left),
            min(self.top, other.top),
            max(self.right, other.right),
            max(self.bottom, other.bottom),
        )


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
        parts: the regions, from top to bottom.
        labels: (H, W) uint8, label of every pixel.
        own: (H, W) uint8, 1 where a pixel and most of its neighbours have the label that is looked for there, of faint
            colours too if they were asked for.
        typical: (H, W) uint8, 1 where a pixel has that label by its typical colour.
        pixels: (H, W, 3) uint8 BGR.
        foreign_pixels: how many pixels have the label of another marker.
        likelihoods: (H, W) uint8, how typical each colour is of its label, see `ColorTable`.
    """

    def __init__(
        self, image: ImageArray, table: ColorTable, looks: Sequence[tuple[int, Region]], *, faint: bool = False
    ) -> None:
        """Cut out and classify.

        Args:
            image: (H, W, 3) uint8 BGR.
            table: colours of the labels.
            looks: label and region of each part, at least one.
            faint: whether faint colours count as a marker's own.
        """
        self.parts: list[Cutout] = []
        row, width = _GAP_PX, 0
        for label, region in looks:
            self.parts.append(Cutout(label, region, row))
            row += region.bottom - region.top + _GAP_PX
            width = max(width, region.right - region.left)
        pixels: ImageArray = np.zeros((row, width + _GAP_PX, 3), np.uint8)
        if table.faint[0] != 0:
            pixels[:] = _nobodys_color(table)
        wanted: ImageArray = np.ones((row, 1), np.uint8)
        for label, (left, top, right, bottom), row in self.parts:
            end = row + bottom - top
            pixels[row:end, : right - left] = image[top:bottom, left:right]
            wanted[row : end + _GAP_PX] = label
        self.pixels = pixels
        self.labels, packed = table.classify(pixels)
        self.likelihoods: ImageArray = np.asarray(cv2.LUT(packed, table.likelihoods), dtype=np.uint8)
        self.typical: ImageArray = (self.labels == wanted).view(np.uint8)
        matching = self.typical
        if faint:
            labels = np.asarray(cv2.LUT(packed, table.faint), dtype=np.uint8).reshape(self.labels.shape)
            matching = (labels == wanted).view(np.uint8)
        self.own: ImageArray = _of_most(matching)
        self.foreign_pixels: int = cv2.countNonZero(self.labels) - cv2.countNonZero(self.typical)

    def foreign_in(self, window: tuple[slice, slice]) -> int:
        """Return how many pixels of a window have the label of another marker."""
        return cv2.countNonZero(self.labels[window]) - cv2.countNonZero(self.typical[window])


def marker_mask(image: ImageArray, table: ColorTable, marker: str) -> ImageArray:
    """Return 255 where the detector would take a pixel for a marker's, 0 elsewhere, (H, W) uint8.

    Args:
        image: (H, W, 3) uint8 BGR.
        table: colours in use.
        marker: name.

    Raises:
        ConfigError: no such marker.
    """
    if marker not in table.names:
        raise ConfigError(f"mask={marker}: no such marker; one of {', '.join(table.names)}")
    height, width = image.shape[:2]
    cutouts = Cutouts(image, table, [(table.names.index(marker) + 1, Region(0, 0, width, height))])
    row = cutouts.parts[0].row
    return cutouts.own[row : row + height, :width] * np.uint8(255)


def _of_most(own: ImageArray) -> ImageArray:
    """Return where most of nine neighbours are 1, so that single wrong pixels go, right or wrong.

    In the row that the picture's memory is, neighbours are constant steps apart: five sums of whole arrays do it,
    where a median of labels takes forty times as long. The gaps keep the end of a row apart from the next one's start.

    Args:
        own: (H, W) uint8, 0 or 1; 0 in its first and last rows and its last columns.
    """
    width = own.shape[1]
    flat = own.reshape(-1)
    sums = flat[: -2 * width] + flat[width:-width]
    sums += flat[2 * width :]
    squares = sums[:-2] + sums[1:-1]
    squares += sums[2:]
    most: ImageArray = np.zeros(own.shape, np.uint8)
    np.greater_equal(squares, _MAJORITY, out=most.reshape(-1)[width + 1 : -width - 1].view(np.bool_))
    return most


def _nobodys_color(table: ColorTable) -> tuple[int, int, int]:
    """Return a colour that is not even faintly a marker's, blue, green, red; black where every colour is."""
    packed = int(np.argmin(table.faint))
    return ((packed & 31) << 3, ((packed >> 5) & 63) << 2, (packed >> 11) << 3)
