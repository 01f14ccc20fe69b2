"""Blobs that hang on another marker: its rim, or a seam where its paint mixes with what is beside it.

A pixel on the edge of green paint on bright skin is yellowish, and where the edge is blurred, turned away or lit by the
paint, such pixels make a blob of their own. Its colour lies between that of the paint and that of the surroundings.
Real paint does not: of two colours that touch, the mixed one is that which lies nearer to a mixture of the other.
"""

from __future__ import annotations

from typing import Final, NamedTuple

import cv2
import numpy as np

from rhot.arrays import FloatArray, ImageArray
from rhot_capture.detection.blob import Blob

_LIKELY: Final = 0.75
"""A blob is a mixture when it is nearer to one than so many times what its neighbour is. 1 is where nothing speaks for
either; on rendered pictures in seven lights and sizes paint is at 0.9 to 160 (median 4), a seam at 0.03 to 0.7."""
_OFF: Final = 0.4
"""And when it is no further from one than this share of how far both colours are apart: two paints may well be at the
edge of the first rule, but then both are far from any mixture (0.46 for yellow beside green)."""
_CLOSEST: Final = 20
"""One in so many colours of the surroundings may be nearer to making a mixture than the one that counts: noise."""
_WITHIN_2: Final = np.ones((5, 5), np.uint8)


class Neighbour(NamedTuple):
    """What another marker has around a blob.

    Attributes:
        share: of the ring of two pixels around the blob.
        pixels: in its window.
        mask: (h, w) bool, where in its window; nowhere when there is no other marker.
        around: (h, w) bool, where neither of both nor the ring is, and no paint.
    """

    share: float
    pixels: int
    mask: ImageArray
    around: ImageArray


def neighbour_of(blob: Blob, labels: ImageArray, label: int) -> Neighbour:
    """Return the other marker that has most of the ring around a blob.

    Args:
        blob: the blob in question.
        labels: (h, w) uint8, label of every pixel in its window, as far as it is seen.
        label: of its marker.
    """
    near = cv2.dilate(blob.seen, _WITHIN_2) > 0
    ring = labels[near & (blob.seen == 0)]
    counts = np.bincount(ring, minlength=label + 1)
    counts[0] = counts[label] = 0
    other = int(np.argmax(counts))
    mask = (labels == other) & (other > 0)
    return Neighbour(float(counts[other]) / max(1, len(ring)), int(np.count_nonzero(mask)), mask, ~near & (labels == 0))


def is_mixture(blob: Blob, beside: Neighbour, pixels: ImageArray) -> bool:
    """Tell whether a blob has the colour of its neighbour mixed with what is around both, rather than one of its own.

    Args:
        blob: the blob in question.
        beside: its neighbour, of at least one pixel.
        pixels: (h, w, 3) uint8 BGR, of its window.
    """
    around = pixels[beside.around].astype(np.float64)
    if not len(around):
        return False
    own, other = pixels[blob.seen > 0].mean(axis=0), pixels[beside.mask].mean(axis=0)
    off = _off_mixtures(own, other, around)
    apart = float(np.linalg.norm(own - other))
    return off < _OFF * apart and off < _LIKELY * _off_mixtures(other, own, around)


def _off_mixtures(color: FloatArray, paint: FloatArray, around: FloatArray) -> float:
    """Return how far a colour is from mixtures of a paint with what is around, grey levels.

    Args:
        color, paint: (3,).
        around: (N, 3), N at least 1.
    """
    along = around - paint
    share = (along @ (color - paint)) / np.maximum((along * along).sum(axis=1), 1.0)
    away = paint + np.clip(share, 0.0, 1.0)[:, None] * along - color
    off: FloatArray = np.sqrt((away * away).sum(axis=1))
    nearest = len(off) // _CLOSEST
    return float(np.partition(off, nearest)[nearest])
