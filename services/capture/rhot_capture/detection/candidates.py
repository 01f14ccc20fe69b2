"""Which blobs may be a marker, and how much each is like it."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Final, Literal, NamedTuple

import cv2
import numpy as np

from rhot.arrays import ImageArray
from rhot_capture.detection.blob import Blob
from rhot_capture.detection.cutouts import Cutouts
from rhot_capture.detection.score import Evidence
from rhot_capture.detection.seams import is_mixture, neighbour_of
from rhot_capture.detection.track import MarkerTrack

MIN_PLAUSIBILITY: Final = 0.1
"""A blob that is less like a marker than this is not reported."""
MIN_SOLIDITY: Final = 0.5
"""Area through that of the convex hull; less is ragged."""
MIN_FILL: Final = 0.5
"""Share of a blob that must have the marker's own colour; holes may be shine."""
_TYPICAL_LIKELIHOOD: Final = 0.35
"""Mean of exp(−d²/2) over samples of a three-dimensional normal distribution: 2^(−3/2)."""
_TYPICAL_SOLIDITY: Final = 0.85
"""From here on a blob counts as convex: a mask of pixels never fills its hull; chosen."""
_MAX_ADJACENCY: Final = 0.4
"""Share of a blob's outline that a larger blob of another marker may take; chosen."""
_MAX_FAINT_ADJACENCY: Final = 0.1
"""The same of a faint blob: between another paint and skin lies a whole seam of colours that are neither's."""
_CLING_RATIO: Final = 1.5
"""How many times larger that other blob must be; chosen."""
_LEAST_BESIDE_PX: Final = 4
"""Pixels of other markers near a blob from which on its neighbours are looked at."""
_SLIVER_SCORE: Final = 0.5
"""Factor on the likeness of what has no core; chosen."""
_LEAST_TYPICAL: Final = 0.5
"""Of a faint blob, as a share of the marker's smallest area: with fewer pixels of its typical colour it may be where
two other colours mix."""
_BOX_3: Final = np.ones((3, 3), np.uint8)


Reason = Literal["too small", "too large", "ragged", "hollow", "thin", "rim", "unlike", "cut", "outsized"]
"""Why a blob is no candidate: outside of the marker's areas; not solid; too little of the marker's own colour; no core;
hanging on a larger blob of another marker, or where that one mixes with what is beside it; not like the marker at all;
not wholly in the region that was searched; much larger than paint of its hand can be by the other markers."""


class Candidate(NamedTuple):
    """A blob that may be a marker.

    Attributes:
        blob: where it is.
        plausibility: 0 to 1, how much it is like the marker; decides which blob is chosen and whether one is.
        evidence: for its score, but for what tracks and other blobs add.
        fill: share of it that has the marker's own colour.
    """

    blob: Blob
    plausibility: float
    evidence: Evidence
    fill: float


class Refusal(NamedTuple):
    """A blob that is no candidate.

    Attributes:
        blob: where it is.
        reason: the first that applied; what comes after it was not looked at.
        fill: share of it that has the marker's own colour; NaN where that was not looked at.
    """

    blob: Blob
    reason: Reason
    fill: float = math.nan


def judge(
    cutouts: Cutouts,
    blob: Blob,
    label: int,
    least_px: float,
    track: MarkerTrack,
    alone: bool,
    *,
    faint: bool = False,
) -> Candidate | Refusal:
    """Return a blob as candidate for a marker, or why it is none.

    Args:
        cutouts: where it was found.
        blob: the blob in question.
        label: of the marker.
        least_px: smallest area of the marker, square pixels.
        track: of the marker.
        alone: whether it is the only one; its plausibility may then be stated too low, as long as it is enough.
        faint: whether it was found by faint colours; what speaks for it are its pixels of typical colour then.
    """
    window = blob.cut
    own, own_pixels = blob.seen, int(blob.area)
    if blob.has_holes:
        own = cutouts.own[window] & blob.seen
        own_pixels = cv2.countNonZero(own)
    fill = own_pixels / max(blob.area, 1.0)
    if fill < MIN_FILL:
        return Refusal(blob, "hollow", fill)
    # A thin line or a ring is the mixed rim of another marker, not paint of its own; unless the marker was just
    # here and is being covered.
    thin = not _has_core(blob, own, own_pixels)
    if thin and not track.continues(*blob.middle):
        return Refusal(blob, "thin", fill)
    # In most frames the first of these decides.
    adjacency = _MAX_ADJACENCY
    larger = _CLING_RATIO * blob.area
    if faint:
        typical = cv2.countNonZero(cutouts.typical[window] & own)
        adjacency, larger = _MAX_FAINT_ADJACENCY, _CLING_RATIO * typical
    if _is_rim(cutouts, blob, label, adjacency, larger):
        return Refusal(blob, "rim", fill)
    if faint:
        least_typical = _LEAST_TYPICAL * least_px
        colour = typical / (typical + least_typical) if typical >= least_typical else 0.0
    else:
        colour = min(1.0, cv2.mean(cutouts.likelihoods[window], own)[0] / (255.0 * _TYPICAL_LIKELIHOOD))
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
    if solidity < MIN_SOLIDITY:
        return Refusal(blob, "ragged", fill)
    if plausibility <= 0.0:
        return Refusal(blob, "unlike", fill)
    if faint and blob.seen.shape == blob.mask.shape:
        # Pure paint says how much of the mixed pixels beside it is paint; they themselves would say all of it is.
        blob = blob._replace(mask=255 * (cutouts.typical[window] & own))
    return Candidate(blob, plausibility, Evidence(math.log(pure), -blob.border_share, 0.0), fill)


def _is_rim(cutouts: Cutouts, blob: Blob, label: int, adjacency: float, larger: float) -> bool:
    """Tell whether a blob is the stained rim of another marker, or a seam between that and what is beside it.

    Args:
        cutouts: where it was found.
        blob: the blob in question.
        label: of its marker.
        adjacency: share of the ring around it from which on a larger marker has it as its rim.
        larger: pixels of a larger marker.
    """
    if cutouts.foreign_pixels < _LEAST_BESIDE_PX or cutouts.foreign_in(blob.cut) < _LEAST_BESIDE_PX:
        return False
    beside = neighbour_of(blob, cutouts.labels[blob.cut], label)
    if beside.share > adjacency and beside.pixels > larger:
        return True
    return beside.share > _MAX_FAINT_ADJACENCY and is_mixture(blob, beside, cutouts.pixels[blob.cut])


def continuing(candidate: Candidate, track: MarkerTrack) -> float:
    """Return how much a candidate is like the marker, times how well it continues the marker's track."""
    blob = candidate.blob
    return candidate.plausibility * track.preference(*blob.middle, blob.area)


def likeliest(candidates: Sequence[Candidate], track: MarkerTrack, usual_px: float = math.inf) -> Candidate | None:
    """Return the candidate that is most surely a marker; None where none is surely enough.

    Args:
        candidates: for the marker, at least one.
        track: of that marker.
        usual_px: square pixels of the marker when it is wholly seen; larger is not more like it.
    """
    best = candidates[0]
    if len(candidates) > 1:
        weights = [continuing(one, track) * min(one.blob.area, usual_px) for one in candidates]
        first, second = sorted(range(len(candidates)), key=weights.__getitem__, reverse=True)[:2]
        share = weights[first] / (weights[first] + weights[second])
        best = candidates[first]
        best = best._replace(
            plausibility=best.plausibility * share, evidence=best.evidence._replace(alone=math.log(share))
        )
    return best if best.plausibility >= MIN_PLAUSIBILITY else None


def _has_core(blob: Blob, own: ImageArray, own_pixels: int) -> bool:
    """Tell whether some pixel of a blob has all its eight neighbours in it; `own` is 1 or more in its `own_pixels`."""
    # Without holes, more than two pixels to each point of the outline leave no doubt.
    if own_pixels == blob.area and own_pixels > 2 * sum(map(len, blob.contours)):
        return True
    return cv2.countNonZero(cv2.erode(own, _BOX_3, borderType=cv2.BORDER_CONSTANT, borderValue=0)) > 0
