"""Where in a whole picture markers may be, by looking at every second pixel of every second row.

A blob that is a marker holds three by three pixels of its colour (`rhot_capture.detector` believes thinner ones only
where a marker just was), and of these at least one is looked at.
"""

from __future__ import annotations

from typing import Final

import cv2
import numpy as np

from rhot_capture.color_table import ColorTable, ImageArray
from rhot_capture.cutouts import Region

_STEP: Final = 2
_ROOM_PX: Final = 10
"""Round the pixels that were looked at: what was passed over, the padding of a blob, a part split off by shine."""
_MOST_PLACES: Final = 100
_MOST_REGIONS: Final = 6
"""For one label; the largest are kept."""


def find_regions(image: ImageArray, table: ColorTable) -> list[tuple[int, Region]]:
    """Return label and place of every region that may hold a marker.

    Args:
        image: (H, W, 3) uint8 BGR.
        table: colours of the labels.

    Returns:
        regions; those of one label do not touch, and hold all that is of its colour, but for speckle where there is
        more than can be looked at.
    """
    height, width = image.shape[:2]
    labels = _sampled_labels(image, table)
    count = len(table.names)
    contours, _ = cv2.findContours(labels, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_SIMPLE)
    if len(contours) > _MOST_PLACES:
        contours = sorted(contours, key=cv2.contourArea, reverse=True)[:_MOST_PLACES]
    boxes: dict[int, list[tuple[int, Region]]] = {}
    for contour in contours:
        left, top, across, down = cv2.boundingRect(contour)
        part = labels[top : top + down, left : left + across]
        present = np.bincount(part.ravel(), minlength=count + 1).tolist()
        found = [label for label in range(1, count + 1) if present[label]]
        for label in found:
            x, y, w, h = (0, 0, across, down) if len(found) == 1 else cv2.boundingRect(cv2.inRange(part, label, label))
            region = Region(
                max(0, _STEP * (left + x) - _ROOM_PX),
                max(0, _STEP * (top + y) - _ROOM_PX),
                min(width, _STEP * (left + x + w - 1) + _ROOM_PX + 1),
                min(height, _STEP * (top + y + h - 1) + _ROOM_PX + 1),
            )
            boxes.setdefault(label, []).append((present[label], region))
    return [(label, region) for label, sized in boxes.items() for region in _joined(sized)]


def _sampled_labels(image: ImageArray, table: ColorTable) -> ImageArray:
    """Return the labels of every second pixel of every second row, (H/2, W/2)."""
    packed = np.asarray(cv2.cvtColor(image[::_STEP], cv2.COLOR_BGR2BGR565)).view(np.uint16)[..., 0]
    width = packed.shape[1] // 2
    # Two colours as one number, cut down to the first of them: several times as fast as a copy with a step.
    halved = packed[:, : 2 * width].view("<u4").astype(np.uint16)
    return np.asarray(cv2.LUT(halved, table.labels), dtype=np.uint8).reshape(halved.shape)


def _joined(sized: list[tuple[int, Region]]) -> list[Region]:
    """Return the largest regions, those that overlap as one."""
    if len(sized) > 1:
        sized.sort(reverse=True)
    joined: list[Region] = []
    for _, region in sized[:_MOST_REGIONS]:
        grown = region
        apart: list[Region] = []
        for other in joined:
            if (
                grown.left < other.right
                and other.left < grown.right
                and grown.top < other.bottom
                and other.top < grown.bottom
            ):
                grown = Region(
                    min(grown.left, other.left),
                    min(grown.top, other.top),
                    max(grown.right, other.right),
                    max(grown.bottom, other.bottom),
                )
            else:
                apart.append(other)
        joined = [*apart, grown]
    return joined
