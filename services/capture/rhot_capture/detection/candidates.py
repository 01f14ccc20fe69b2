"""Which blobs may be a marker, and how much each is like it."""

from __future__ import annotations

import math
from typing import Final, NamedTuple

import cv2
import numpy as np

from rhot_capture.detection.blob import Blob
from rhot_capture.detection.color_table import ImageArray
from rhot_capture.detection.cutouts import Cutouts
from rhot_capture.detection.score import Evidence
from rhot_capture.detection.track import MarkerTrack

MIN_PLAUSIBILITY: Final = 0.1
"""A blob that is less like a marker than this is not reported."""
MIN_SOLIDITY: Final = 0.5
MIN_FILL: Final = 0.5
"""Share of a blob that must have the marker's own colour; holes may be shine."""
TYPICAL_LIKELIHOOD: Final = 0.35
"""Mean of exp(−d²/2) over samples of a three-dimensional normal distribution: 2^(−3/2)."""
_TYPICAL_SOLIDITY: Final = 0.85
_MAX_ADJACENCY: Final = 0.4
_CLING_RATIO: Final = 1.5
_SLIVER_SCORE: Final = 0.5
_LONGER: Final = math.sqrt(2.0) - 1.0
"""A diagonal step than a straight one."""
_BOX_3: Final = np.ones((3, 3), np.uint8)
_BOX_5: Final = np.ones((5, 5), np.uint8)


class Candidate(NamedTuple):
    """A blob that may be a marker.

    Attributes:
        blob: where it is.
        plausibility: 0 to 1, how much it is like the marker; decides which blob is chosen and whether one is.
        evidence: for its score, but for what tracks and other blobs tell.
    """

    blob: Blob
    plausibility: float
    evidence: Evidence


def judge(
    cutouts: Cutouts, blob: Blob, label: int, least_px: float, track: MarkerTrack, alone: bool
) -> Candidate | None:
    """Return a blob as candidate for a marker; None when it is none.

    Args:
        cutouts: where it was found.
        blob: it.
        label: of the marker.
        least_px: smallest area of the marker, square pixels.
        track: of the marker.
        alone: whether it is the only one; its plausibility may then be stated too low, as long as it is enough.
    """
    window = blob.cut
    own, own_pixels = blob.seen, int(blob.area)
    if blob.has_holes:
        own = cutouts.own[window] & blob.seen
        own_pixels = cv2.countNonZero(own)
        if own_pixels < MIN_FILL * blob.area:
            return None
    # A thin line or a ring is the mixed rim of another marker, not paint of its own; unless the marker was just
    # here and is being covered.
    thin = _is_thin(blob, own, own_pixels)
    if thin and not track.continues(*middle_of(blob)):
        return None
    # In most frames the first of these tells already.
    larger = _CLING_RATIO * blob.area
    surrounded = cutouts.foreign_pixels > larger and cutouts.foreign_in(window) > larger
    if surrounded and clings(blob, cutouts.labels[window], label):
        return None
    colour = min(1.0, cv2.mean(cutouts.likelihoods[window], own)[0] / (255.0 * TYPICAL_LIKELIHOOD))
    size = blob.area / (blob.area + least_px)
    # A sliver is all rim: none of its pixels is pure paint.
    pure = colour * (_SLIVER_SCORE if thin else 1.0)
    likeness = pure * size * (1.0 - blob.border_share)
    # The box holds the convex hull; the hull itself takes long to find.
    solidity = blob.box_fill
    plausibility = likeness * min(1.0, solidity / _TYPICAL_SOLIDITY)
    if not alone or solidity < MIN_SOLIDITY or plausibility < MIN_PLAUSIBILITY:
        solidity = blob.solidity
        plausibility = likeness * min(1.0, solidity / _TYPICAL_SOLIDITY)
    if solidity < MIN_SOLIDITY or plausibility <= 0.0:
        return None
    return Candidate(blob, plausibility, Evidence(math.log(pure), -blob.border_share, 0.0))


def _is_thin(blob: Blob, own: ImageArray, own_pixels: int) -> bool:
    """Tell whether no pixel of a blob has all its eight neighbours in it.

    Args:
        blob: it.
        own: (h, w) uint8, 1 where its pixels have its own label.
        own_pixels: how many.
    """
    if own_pixels == blob.area:
        # Without holes, what is thin is all outline and inner corners of the outline; of these there are no more than
        # the outline has diagonal steps, which is less than its points and soon told.
        points = sum(map(len, blob.contours))
        if own_pixels > 2 * points:
            return False
        diagonals = sum([cv2.arcLength(each, True) - len(each) for each in blob.contours]) / _LONGER
        if own_pixels > points + diagonals + 0.5:
            return False
    return cv2.countNonZero(cv2.erode(own, _BOX_3, borderType=cv2.BORDER_CONSTANT, borderValue=0)) == 0


def clings(blob: Blob, labels: ImageArray, label: int) -> bool:
    """Tell whether a blob hangs on a larger blob of another marker, as the stained rim of that marker does.

    Args:
        blob: it.
        labels: (h, w) uint8, label of every pixel in its window, as far as it is seen.
        label: of its marker.
    """
    ring = labels[(cv2.dilate(blob.seen, _BOX_5) > 0) & (blob.seen == 0)]
    counts = np.bincount(ring, minlength=label + 1)
    counts[0] = counts[label] = 0
    other = int(np.argmax(counts))
    if counts[other] <= _MAX_ADJACENCY * len(ring):
        return False
    return bool(np.count_nonzero(labels == other) > _CLING_RATIO * blob.area)


def middle_of(blob: Blob) -> tuple[float, float]:
    """Return u and v of the middle of a blob's window, pixels."""
    height, width = blob.mask.shape
    return blob.x0 + 0.5 * (width - 1), blob.y0 + 0.5 * (height - 1)
