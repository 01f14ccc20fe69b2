"""Track of a marker in one camera: a soft preference for blobs near the predicted position."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Final

import cv2
import numpy as np

from rhot.arrays import ImageArray
from rhot.geometry.hull import Region
from rhot_capture.detection.color_table import pack

# Find the regions of an image that may contain markers, from every third pixel of every third row.
#
# A marker's blob contains 3x3 pixels of its colour, one of which is sampled; `rhot_capture.detection.candidates`
# accepts thinner blobs only where a marker just was.

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


_MEMORY_FRAMES: Final = 10
"""Frames without the marker after which the track is dropped; chosen: a sixth of a second at 60 Hz."""
_GATE_MIN_PX: Final = 25.0
_GATE_RATIO: Final = 1.5
_GATE_GROWTH: Final = 0.5
"""The gate is a standard deviation: the maximum of this many pixels and this multiple of the root of the marker's area,
growing by this share with each frame without the marker. Chosen: a fingertip that stops suddenly from 2 m/s is 22
pixels from the prediction at 60 Hz and 80 cm."""
_SLIVER_FRAMES: Final = 3
_SLIVER_GATE_PX: Final = 6.0
"""Thin remains of a marker being occluded are accepted after at most this many frames, counted from the last detection,
and within this distance from the prediction; chosen."""
_MARGIN_PX: Final = 8.0
_MARGIN_PER_MOTION: Final = 0.5
"""Change of motion between two frames, as a share of it; a tip at 1.5 m/s moves 17 pixels in 1/60 s at 80 cm."""


class MarkerTrack:
    """One marker's last position, motion per frame and size in one camera."""

    def __init__(self) -> None:
        self._u = 0.0
        self._v = 0.0
        self._motion_u = 0.0
        self._motion_v = 0.0
        self._area = 0.0
        self._reach = (0.0, 0.0)
        self._missed = _MEMORY_FRAMES

    @property
    def is_recent(self) -> bool:
        """Whether the marker was seen recently, so that its position is predicted."""
        return self._missed < _MEMORY_FRAMES

    @property
    def margin_px(self) -> float:
        """Margin around the predicted position; grows with the speed."""
        return _MARGIN_PX + _MARGIN_PER_MOTION * max(abs(self._motion_u), abs(self._motion_v))

    @property
    def expected(self) -> tuple[float, float] | None:
        """Predicted u and v, pixels; None if the marker was not in the last frame."""
        return None if self._missed > 0 else (self._u + self._motion_u, self._v + self._motion_v)

    def region(self, margin_px: float, height: int, width: int) -> Region | None:
        """Return the region in which the marker is predicted; None if it was not in the last frame.

        Args:
            margin_px: on all sides.
            height: of the picture, pixels.
            width: of the picture, pixels.
        """
        if (expected := self.expected) is None:
            return None
        u, v = expected
        reach_u, reach_v = self._reach[0] + margin_px, self._reach[1] + margin_px
        left, top = max(0, int(u - reach_u)), max(0, int(v - reach_v))
        right, bottom = min(width, int(u + reach_u) + 1), min(height, int(v + reach_v) + 1)
        return Region(left, top, right, bottom) if left < right and top < bottom else None

    def preference(self, u: float, v: float, area: float) -> float:
        """Return the agreement of a blob with the track, 0 to 1; 1 if there is no track.

        Args:
            u: centre of the blob, pixels to the right.
            v: centre of the blob, pixels down.
            area: of the blob, square pixels.
        """
        if not self.is_recent:
            return 1.0
        frames = self._missed + 1
        gate = max(_GATE_MIN_PX, _GATE_RATIO * math.sqrt(self._area)) * (1.0 + _GATE_GROWTH * self._missed)
        away = math.hypot(u - self._u - frames * self._motion_u, v - self._v - frames * self._motion_v)
        ratio = min(area, self._area) / max(area, self._area)
        # Smallest preference: a blob far from the prediction must be 20 times better to be chosen, unless it
        # is alone.
        return max(0.05, math.exp(-0.5 * (away / gate) ** 2) * math.sqrt(ratio))

    def continues(self, u: float, v: float) -> bool:
        """Return whether a blob is near enough to the prediction to accept even a thin one.

        Args:
            u: centre of the blob, pixels to the right.
            v: centre of the blob, pixels down.
        """
        frames = self._missed + 1
        away = math.hypot(u - self._u - frames * self._motion_u, v - self._v - frames * self._motion_v)
        return frames <= _SLIVER_FRAMES and away <= _SLIVER_GATE_PX

    def update(self, u: float, v: float, area: float, reach_px: tuple[float, float] = (0.0, 0.0)) -> None:
        """Update the track with the marker's position in this frame.

        Args:
            u: centre, pixels to the right.
            v: centre, pixels down.
            area: square pixels.
            reach_px: half of its width and of its height, pixels.
        """
        if self._missed == 0:
            self._motion_u, self._motion_v = u - self._u, v - self._v
        else:
            self._motion_u = self._motion_v = 0.0
        self._u, self._v, self._area, self._reach = u, v, area, reach_px
        self._missed = 0

    def miss(self) -> None:
        """Update the track with a frame without the marker."""
        self._missed += 1
