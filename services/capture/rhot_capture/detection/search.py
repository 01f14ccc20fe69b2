"""Find the regions of an image that may contain markers, from every third pixel of every third row.

A marker's blob contains 3x3 pixels of its colour, one of which is sampled; `rhot_capture.detection.candidates` accepts
thinner blobs only where a marker just was.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

import cv2
import numpy as np

from rhot.arrays import ImageArray
from rhot.geometry.region import Region
from rhot_capture.detection.color_table import pack

_STEP: Final = 3
_FIRST: Final = 1
"""Every third row and column, starting with the second: the centre pixel of each 3x3 block."""
_ROOM_PX: Final = 9
"""Margin around the sampled pixels: skipped pixels, the padding of a blob, and one more pixel. Regions of parts that a
highlight separates overlap and are merged."""
_BEFORE: Final = _FIRST - _ROOM_PX
_AFTER: Final = _FIRST - _STEP + _ROOM_PX + 1
_MOST_CONTOURS: Final = 100
"""Largest number of contours examined, the largest ones: limits the time for pictures full of speckle. Chosen."""


def find_regions(image: ImageArray, labels_of: ImageArray) -> list[tuple[int, Region]]:
    """Return label and bounds of every region that may contain a marker.

    Args:
        image: (H, W, 3) uint8 BGR.
        labels_of: (65536,) uint8, the label of each 5-6-5 colour.

    Returns:
        Regions; those of one label do not overlap. They contain all pixels of its colour, except speckle beyond
        the limits above.
    """
    height, width = image.shape[:2]
    labels = _sampled_labels(image, labels_of)
    contours, _ = cv2.findContours(labels, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_SIMPLE)
    if len(contours) > _MOST_CONTOURS:
        contours = sorted(contours, key=cv2.contourArea, reverse=True)[:_MOST_CONTOURS]
    boxes: dict[int, list[tuple[int, Region]]] = {}
    for contour in contours:
        left, top, across, down = cv2.boundingRect(contour)
        for label, pixels, (x, y, w, h) in _labels_in(labels[top : top + down, left : left + across]):
            region = Region(
                max(0, _STEP * (left + x) + _BEFORE),
                max(0, _STEP * (top + y) + _BEFORE),
                min(width, _STEP * (left + x + w) + _AFTER),
                min(height, _STEP * (top + y + h) + _AFTER),
            )
            boxes.setdefault(label, []).append((pixels, region))
    return [(label, region) for label, sized in boxes.items() for region in _joined(sized)]


def _labels_in(part: ImageArray) -> list[tuple[int, int, Sequence[int]]]:
    """Return the labels that occur, each with its number of pixels and its bounding rectangle.

    Args:
        part: (h, w) uint8 labels, not all 0; usually only one label.
    """
    values = part.tobytes()
    highest = max(values)
    pixels = values.count(highest)
    if pixels + values.count(0) == len(values):
        height, width = part.shape
        return [(highest, pixels, (0, 0, width, height))]
    return [
        (label, values.count(label), cv2.boundingRect(cv2.inRange(part, label, label)))
        for label in sorted(set(values))
        if label
    ]


def _sampled_labels(image: ImageArray, labels_of: ImageArray) -> ImageArray:
    """Return the labels of every third pixel of every third row, (H/3, W/3)."""
    packed = pack(image[_FIRST::_STEP])[..., 0]
    # Columns are skipped after the conversion: a strided copy is ten times as fast for two bytes as for three.
    sampled = np.ascontiguousarray(packed[:, _FIRST::_STEP])
    return np.asarray(cv2.LUT(sampled, labels_of), dtype=np.uint8).reshape(sampled.shape)


def _joined(sized: list[tuple[int, Region]]) -> list[Region]:
    """Return the largest regions; overlapping ones are merged."""
    if len(sized) == 1:
        return [sized[0][1]]
    sized.sort(reverse=True)
    joined: list[Region] = []
    # Largest number of regions of one label before merging; the largest are kept.
    for _, region in sized[:6]:
        merged = region
        # Merging enlarges a region, which may then overlap a region that it did not overlap before.
        while overlapping := [other for other in joined if merged.overlaps(other)]:
            joined = [other for other in joined if not merged.overlaps(other)]
            for other in overlapping:
                merged = merged.joined(other)
        joined.append(merged)
    return joined
