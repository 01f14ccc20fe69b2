"""Detect blobs that are the edge of another marker: mixtures of its paint with the surroundings.

A pixel on the edge of green paint on bright skin is yellowish. Where the edge is blurred, seen obliquely or lit by the
paint, such pixels form a blob of their own, whose colour lies between those of the paint and the surroundings. The
colour of real paint does not: of two adjacent colours, the mixture is the one nearer to mixtures of the other.
"""

from __future__ import annotations

from typing import Final, NamedTuple

import cv2
import numpy as np

from rhot.arrays import FloatArray, ImageArray
from rhot_capture.detection.blob import Blob

_LIKELY: Final = 0.75
"""A blob is a mixture if its distance from mixtures is less than this times that of its neighbour. On rendered pictures
with seven lights and sizes, the ratio is 0.9 to 160 (median 4) for paint and 0.03 to 0.7 for seams."""
_OFF: Final = 0.4
"""And if that distance is less than this share of the distance between both colours: two paints can be near the first
limit, but then both are far from any mixture (0.46 for yellow beside green)."""
_CLOSEST: Final = 20
"""The distance from mixtures is the quantile 1 / this over the colours of the surroundings, because of noise."""
_WITHIN_2: Final = np.ones((5, 5), np.uint8)


class Neighbour(NamedTuple):
    """Another marker beside a blob.

    Attributes:
        share: of the ring of two pixels around the blob.
        pixels: their number in the blob's window.
        mask: (h, w) bool, its pixels in the window; all false without another marker.
        around: (h, w) bool, surroundings: no paint, and outside the blob and the ring.
    """

    share: float
    pixels: int
    mask: ImageArray
    around: ImageArray


def neighbour_of(blob: Blob, labels: ImageArray, label: int) -> Neighbour:
    """Return the other marker with the largest share of the ring around a blob.

    Args:
        blob: the blob.
        labels: (h, w) uint8, labels of `blob.seen`.
        label: of the blob's marker.
    """
    near = cv2.dilate(blob.seen, _WITHIN_2) > 0
    ring = labels[near & (blob.seen == 0)]
    counts = np.bincount(ring, minlength=label + 1)
    counts[0] = counts[label] = 0
    other = int(np.argmax(counts))
    mask = (labels == other) & (other > 0)
    return Neighbour(float(counts[other]) / max(1, len(ring)), int(np.count_nonzero(mask)), mask, ~near & (labels == 0))


def is_mixture(blob: Blob, beside: Neighbour, pixels: ImageArray) -> bool:
    """Return whether a blob's colour is a mixture of its neighbour's colour and the surroundings.

    Args:
        blob: the blob.
        beside: its neighbour, of at least one pixel.
        pixels: (h, w, 3) uint8 BGR, colours of `blob.seen`.
    """
    around = pixels[beside.around].astype(np.float64)
    if not len(around):
        return False
    own, other = pixels[blob.seen > 0].mean(axis=0), pixels[beside.mask].mean(axis=0)
    off = _off_mixtures(own, other, around)
    apart = float(np.linalg.norm(own - other))
    return off < _OFF * apart and off < _LIKELY * _off_mixtures(other, own, around)


def _off_mixtures(color: FloatArray, paint: FloatArray, around: FloatArray) -> float:
    """Return the distance of a colour from mixtures of a paint with the surroundings, grey levels.

    Args:
        color, paint: (3,).
        around: (N, 3) colours of the surroundings, N at least 1.
    """
    along = around - paint
    share = (along @ (color - paint)) / np.maximum((along * along).sum(axis=1), 1.0)
    away = paint + np.clip(share, 0.0, 1.0)[:, None] * along - color
    off: FloatArray = np.sqrt((away * away).sum(axis=1))
    nearest = len(off) // _CLOSEST
    return float(np.partition(off, nearest)[nearest])
