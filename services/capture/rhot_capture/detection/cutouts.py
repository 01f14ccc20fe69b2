"""Regions of an image, classified together.

Regions that may contain a marker are copied below each other into one array, so that each step of the classification is
one call for all of them. For such small regions the calls take more time than the pixels.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final, NamedTuple

import cv2
import numpy as np

from rhot.arrays import ImageArray
from rhot.errors import ConfigError
from rhot.geometry.hull import Region
from rhot_capture.detection.color_table import ColorTable

_GAP_PX: Final = 2
"""Gap between regions, so that outlines do not connect."""


class Cutout(NamedTuple):
    """A region in which a marker is searched for.

    Attributes:
        label: of the marker, from 1.
        region: in the image.
        row: of the region's first row in `Cutouts`; its first column is 0.
    """

    label: int
    region: Region
    row: int


class Cutouts:
    """Regions of an image, copied below each other.

    Attributes:
        parts: the regions, from top to bottom.
        labels: (H, W) uint8, label of every pixel.
        own: (H, W) uint8, 1 where a pixel and most of its neighbours have the label of their region; includes faint
            colours if `faint`.
        typical: (H, W) uint8, 1 where a pixel has that label without faint colours.
        pixels: (H, W, 3) uint8 BGR.
        foreign_pixels: number of pixels with the label of another marker.
        likelihoods: (H, W) uint8, likelihood of each colour, see `ColorTable`.
    """

    def __init__(
        self, image: ImageArray, table: ColorTable, looks: Sequence[tuple[int, Region]], *, faint: bool = False
    ) -> None:
        """Copy and classify the regions.

        Args:
            image: (H, W, 3) uint8 BGR.
            table: colours of the labels.
            looks: label and region of each part, at least one.
            faint: whether to include faint colours.
        """
        self.parts: list[Cutout] = []
        row, width = _GAP_PX, 0
        for label, region in looks:
            self.parts.append(Cutout(label, region, row))
            row += region.bottom - region.top + _GAP_PX
            width = max(width, region.right - region.left)
        pixels: ImageArray = np.zeros((row, width + _GAP_PX, 3), np.uint8)
        if table.faint[0] != 0:
            pixels[:] = _unlabelled_color(table)
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
        self.own: ImageArray = _majority(matching)
        self.foreign_pixels: int = cv2.countNonZero(self.labels) - cv2.countNonZero(self.typical)

    def foreign_in(self, window: tuple[slice, slice]) -> int:
        """Return the number of pixels of a window with the label of another marker."""
        return cv2.countNonZero(self.labels[window]) - cv2.countNonZero(self.typical[window])


def marker_mask(image: ImageArray, table: ColorTable, marker: str) -> ImageArray:
    """Return the mask of a marker's colour as the detector uses it, (H, W) uint8, 255 or 0.

    Args:
        image: (H, W, 3) uint8 BGR.
        table: colours in use.
        marker: name.

    Raises:
        ConfigError: no such marker.
    """
    if marker not in table.names:
        raise ConfigError(f"mask={marker}: no such marker; choose one of {', '.join(table.names)}")
    height, width = image.shape[:2]
    cutouts = Cutouts(image, table, [(table.names.index(marker) + 1, Region(0, 0, width, height))])
    row = cutouts.parts[0].row
    return cutouts.own[row : row + height, :width] * np.uint8(255)


def _majority(own: ImageArray) -> ImageArray:
    """Return 1 where most pixels of the 3x3 neighbourhood are 1, which removes single wrong pixels.

    In the flattened array, neighbours are at constant offsets, so sums of whole arrays suffice; a median of the labels
    takes forty times as long. The gaps separate the end of a row from the start of the next.

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
    # Majority of the nine pixels of a 3x3 neighbourhood.
    np.greater_equal(squares, 5, out=most.reshape(-1)[width + 1 : -width - 1].view(np.bool_))
    return most


def _unlabelled_color(table: ColorTable) -> tuple[int, int, int]:
    """Return a colour without a label, faint ones included, blue, green, red; black if there is none."""
    packed = int(np.argmin(table.faint))
    return ((packed & 31) << 3, ((packed >> 5) & 63) << 2, (packed >> 11) << 3)
