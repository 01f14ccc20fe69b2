"""Blobs: connected areas of one marker's colour, as candidates for the marker."""

from __future__ import annotations

from bisect import bisect_right
from collections.abc import Sequence
from typing import Final, NamedTuple, cast

import cv2
import numpy as np
from numpy.typing import NDArray

from rhot.arrays import FloatArray, ImageArray
from rhot.geometry.hull import Region
from rhot_capture.detection.cutouts import Cutout

ContourArray = NDArray[np.int32]

PADDING_PX: Final = 6
"""Margin around a blob's mask: contains its rim and a strip of the surroundings."""
_MAX_CANDIDATES: Final = 6
"""Largest number of blobs of one colour in one region; the largest blobs are kept. Chosen."""
_MERGE_GAP_RATIO: Final = 0.3
_MERGE_GAP_MIN_PX: Final = 2.0
_MERGE_MIN_SHARE: Final = 0.05
_MERGE_MIN_SOLIDITY: Final = 0.75
"""Parts are merged into one blob if their gap is at most this share of the root of the larger area, or this many
pixels; if each has at least this share of the largest part and of the smallest marker; and if their joint solidity is
at least this. Chosen."""
_INSIDE: Final = np.uint8(255)
# Smaller than the padding, so that closing a gap does not reach the window's edge.
_GAP_FILLER: Final = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * PADDING_PX - 1, 2 * PADDING_PX - 1))


class Blob(NamedTuple):
    """A connected area of a marker's colour; a tuple because creating a dataclass for every blob takes longer.

    Attributes:
        x0, y0: image coordinates of the mask's upper left pixel.
        mask: (h, w) uint8, 255 inside the blob with its holes filled; padded by `PADDING_PX` where the image allows.
        cut: rows and columns of the mask in `Cutouts`, limited to the blob's region.
        seen: that part of the mask.
        contours: outlines of the blob's parts, each (n, 1, 2) int32, in coordinates of `Cutouts`.
        box: their bounding rectangle x, y, width, height.
        shift: x and y, pixels, from coordinates of `Cutouts` to image coordinates.
        area: number of pixels inside the filled outline.
        border_share: share of the outline on the image border.
        has_holes: whether some of its pixels may have another label.
    """

    x0: int
    y0: int
    mask: ImageArray
    cut: tuple[slice, slice]
    seen: ImageArray
    contours: tuple[ContourArray, ...]
    box: Sequence[int]
    shift: tuple[int, int]
    area: float
    border_share: float
    has_holes: bool

    @property
    def points(self) -> ContourArray:
        """All points of the outlines, (n, 1, 2) int32, in coordinates of `Cutouts`."""
        return self.contours[0] if len(self.contours) == 1 else np.concatenate(self.contours)

    @property
    def solidity(self) -> float:
        """Area divided by the area of the convex hull."""
        return min(1.0, self.area / _hull_area(self.points))

    @property
    def box_fill(self) -> float:
        """Area divided by the area of the box: a lower bound of the solidity."""
        return self.area / (self.box[2] * self.box[3])

    @property
    def window(self) -> tuple[slice, slice]:
        """Rows and columns of the mask in the image."""
        height, width = self.mask.shape
        return slice(self.y0, self.y0 + height), slice(self.x0, self.x0 + width)

    @property
    def middle(self) -> tuple[float, float]:
        """U and v of the centre of the window, pixels."""
        height, width = self.mask.shape
        return self.x0 + 0.5 * (width - 1), self.y0 + 0.5 * (height - 1)

    @property
    def rim(self) -> FloatArray:
        """(n, 2) float64, points of the outlines, image coordinates."""
        return (self.points[:, 0] + self.shift).astype(np.float64)

    def inside(self, region: Region, shape: tuple[int, int]) -> bool:
        """Return whether the blob does not touch a region's border, except where that is the image border."""
        x, y, width, height = self.box
        left, top = x + self.shift[0], y + self.shift[1]
        return (
            (region.left == 0 or left > region.left)
            and (region.top == 0 or top > region.top)
            and (region.right == shape[1] or left + width < region.right)
            and (region.bottom == shape[0] or top + height < region.bottom)
        )


class _Part(NamedTuple):
    """One connected outline, the number of pixels inside, and its bounding rectangle x, y, width, height."""

    area: float
    outline: ContourArray
    box: Sequence[int]


class _Drawing(NamedTuple):
    """Filled outlines, drawn in one call.

    Attributes:
        filled: (H, W) uint8, 255 inside parts that are the only one in their cutout.
        has_holes: whether any of them may have holes.
    """

    filled: ImageArray
    has_holes: bool


def find_blobs(labels: ImageArray, label: int, min_area: float, max_area: float) -> list[Blob]:
    """Return the blobs of one label in an image, largest first.

    Parts separated by a highlight or a nail's reflection are merged if they are near each other and jointly compact.

    Args:
        labels: (H, W) uint8.
        label: of the marker.
        min_area: smallest area of a merged blob, square pixels.
        max_area: largest area of a merged blob, square pixels.
    """
    height, width = labels.shape
    whole = Cutout(label, Region(0, 0, width, height), 0)
    return blobs_of((labels == label).view(np.uint8), [whole], [(min_area, max_area)], (height, width))[0]


class Outsized(NamedTuple):
    """A blob that is too small or too large for its marker; its mask is drawn on demand only.

    Attributes:
        parts: of the blob.
        cutout: in which it was found.
        shape: height and width of the image.
    """

    parts: list[_Part]
    cutout: Cutout
    shape: tuple[int, int]

    @property
    def blob(self) -> Blob:
        """The blob with its mask."""
        return _blob(self.parts, self.cutout, None, self.shape)


def blobs_of(
    own: ImageArray,
    cutouts: Sequence[Cutout],
    gates: Sequence[tuple[float, float]],
    shape: tuple[int, int],
    outsized: list[Outsized] | None = None,
) -> list[list[Blob]]:
    """Return the blobs of each cutout, largest first; see `find_blobs`.

    Args:
        own: (H, W) uint8, 1 where a pixel has its cutout's label, otherwise 0.
        cutouts: from top to bottom.
        gates: smallest and largest area of a blob in each of them, square pixels.
        shape: height and width of the image.
        outsized: blobs that are too small or too large are appended.
    """
    outsized = [] if outsized is None else outsized
    found, _ = cv2.findContours(own, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
    rows = [cutout.row for cutout in cutouts]
    parts: list[list[_Part]] = [[] for _ in cutouts]
    enclosed = 0.0
    for outline in cast(Sequence[ContourArray], found):
        area = pixel_area(outline)
        enclosed += area
        # Smallest area of an outline, square pixels; smaller ones are noise.
        if area >= 3.0:
            box = cv2.boundingRect(outline)
            cutout = bisect_right(rows, box[1]) - 1
            part = _Part(area, outline, box)
            if area >= _MERGE_MIN_SHARE * gates[cutout][0]:
                parts[cutout].append(part)
            else:
                outsized.append(Outsized([part], cutouts[cutout], shape))
    alone = [each[0].outline for each in parts if len(each) == 1]
    has_holes = cv2.countNonZero(own) != enclosed
    if has_holes or len(alone) < len(found):
        filled = np.zeros(own.shape, np.uint8)
        cv2.drawContours(filled, alone, -1, 255, cv2.FILLED)
    else:
        filled = own * _INSIDE
    drawing = _Drawing(filled, has_holes)
    return [_grouped(*each, drawing, shape, outsized) for each in zip(parts, cutouts, gates, strict=True)]


def _grouped(
    parts: list[_Part],
    cutout: Cutout,
    gate: tuple[float, float],
    drawing: _Drawing,
    shape: tuple[int, int],
    outsized: list[Outsized],
) -> list[Blob]:
    """Return the blobs of a cutout.

    Args:
        parts: in the cutout.
        cutout: the cutout.
        gate: smallest and largest area of a blob, square pixels.
        drawing: of the parts that are the only one in their cutout.
        shape: height and width of the image.
        outsized: blobs that are too small or too large are appended.
    """
    if len(parts) == 1:
        if gate[0] <= parts[0].area <= gate[1]:
            return [_blob(parts, cutout, drawing, shape)]
        outsized.append(Outsized(parts, cutout, shape))
        return []
    free = sorted(parts, key=lambda part: part.area, reverse=True)[: 4 * _MAX_CANDIDATES]
    blobs: list[Blob] = []
    while free and len(blobs) < _MAX_CANDIDATES:
        group, free = _gather(free)
        if gate[0] <= sum([part.area for part in group]) <= gate[1]:
            blobs.append(_blob(group, cutout, None, shape))
        else:
            outsized.append(Outsized(group, cutout, shape))
    return blobs


def pixel_area(contour: ContourArray) -> float:
    """Return the number of pixels inside and on a closed 8-connected chain of pixels (Pick's theorem)."""
    return cv2.contourArea(contour) + 0.5 * len(contour) + 1.0


def _gather(parts: Sequence[_Part]) -> tuple[list[_Part], list[_Part]]:
    """Split parts into those to merge with the first one, and the rest."""
    main = parts[0]
    group, rest = [main], []
    if len(parts) > 1:
        gap = max(_MERGE_GAP_MIN_PX, _MERGE_GAP_RATIO * float(np.sqrt(main.area)))
        for part in parts[1:]:
            near = part.area >= _MERGE_MIN_SHARE * main.area and (_rectangle_gap(main.box, part.box) <= gap)
            if near and _joint_solidity([*group, part]) >= _MERGE_MIN_SOLIDITY:
                group.append(part)
            else:
                rest.append(part)
    return group, rest


def _rectangle_gap(first: Sequence[int], second: Sequence[int]) -> float:
    gap_x = max(first[0], second[0]) - min(first[0] + first[2], second[0] + second[2])
    gap_y = max(first[1], second[1]) - min(first[1] + first[3], second[1] + second[3])
    return float(np.hypot(max(gap_x, 0), max(gap_y, 0)))


def _joint_solidity(parts: Sequence[_Part]) -> float:
    return sum(part.area for part in parts) / _hull_area(np.concatenate([part.outline for part in parts]))


def _hull_area(points: ContourArray) -> float:
    # The hull runs through pixel centres; half a pixel on all sides belongs to it.
    hull = cv2.convexHull(points)
    return cv2.contourArea(hull) + 0.5 * cv2.arcLength(hull, True) + 1.0


def _blob(parts: Sequence[_Part], cutout: Cutout, drawing: _Drawing | None, shape: tuple[int, int]) -> Blob:
    """Return the blob of some parts.

    Args:
        parts: of the blob.
        cutout: in which they were found.
        drawing: of the cutouts, if this blob is the only one in its cutout.
        shape: height and width of the image.
    """
    region = cutout.region
    contours = tuple([part.outline for part in parts])
    shift_x, shift_y = region.left, region.top - cutout.row
    box = parts[0].box if len(parts) == 1 else cv2.boundingRect(np.concatenate(contours))
    left, top = box[0] + shift_x, box[1] + shift_y
    right, bottom = left + box[2], top + box[3]
    x0, y0 = max(left - PADDING_PX, 0), max(top - PADDING_PX, 0)
    x1, y1 = min(right + PADDING_PX, shape[1]), min(bottom + PADDING_PX, shape[0])
    # The part of the window inside the region.
    xa, ya = max(x0, region.left), max(y0, region.top)
    xb, yb = min(x1, region.right), min(y1, region.bottom)
    cut = slice(ya - shift_y, yb - shift_y), slice(xa - shift_x, xb - shift_x)
    area = parts[0].area
    if drawing is not None:
        mask = seen = drawing.filled[cut]
        if xb - xa < x1 - x0 or yb - ya < y1 - y0:
            mask = np.zeros((y1 - y0, x1 - x0), np.uint8)
            mask[ya - y0 : yb - y0, xa - x0 : xb - x0] = seen
    else:
        mask = np.zeros((y1 - y0, x1 - x0), np.uint8)
        cv2.drawContours(mask, contours, -1, 255, cv2.FILLED, offset=(shift_x - x0, shift_y - y0))
        seen = mask[ya - y0 : yb - y0, xa - x0 : xb - x0]
    if len(parts) > 1:
        cv2.morphologyEx(mask, cv2.MORPH_CLOSE, _GAP_FILLER, dst=mask, borderType=cv2.BORDER_CONSTANT, borderValue=0)
        area = float(cv2.countNonZero(mask))
    border_share = 0.0
    if left == 0 or top == 0 or right == shape[1] or bottom == shape[0]:
        u, v = (np.concatenate(contours)[:, 0] + (shift_x, shift_y)).T
        on_border = (u == 0) | (v == 0) | (u == shape[1] - 1) | (v == shape[0] - 1)
        border_share = float(np.count_nonzero(on_border)) / len(u)
    has_holes = drawing is None or drawing.has_holes
    return Blob(x0, y0, mask, cut, seen, contours, box, (shift_x, shift_y), area, border_share, has_holes)
