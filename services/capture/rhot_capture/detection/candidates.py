"""Decide which blobs can be a marker, and rate their plausibility."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Final, Literal, NamedTuple

import cv2
import numpy as np

from rhot.arrays import FloatArray, ImageArray
from rhot_capture.detection.blob import Blob
from rhot_capture.detection.cutouts import Cutouts
from rhot_capture.detection.score import Evidence
from rhot_capture.detection.track import MarkerTrack

# Detect blobs that are the edge of another marker: mixtures of its paint with the surroundings.
#
# A pixel on the edge of green paint on bright skin is yellowish. Where the edge is blurred, seen obliquely or lit by
# the paint, such pixels form a blob of their own, whose colour lies between those of the paint and the surroundings.
# The colour of real paint does not: of two adjacent colours, the mixture is the one nearer to mixtures of the other.

_LIKELY: Final = 0.75
"""A blob is a mixture if its distance from mixtures is less than this times that of its neighbour. On rendered pictures
with seven lights and sizes, the ratio is 0.9 to 160 (median 4) for paint and 0.03 to 0.7 for seams."""
_OFF: Final = 0.4
"""And if that distance is less than this share of the distance between both colours: two paints can be near the first
limit, but then both are far from any mixture (0.46 for yellow beside green)."""
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
    # The distance from mixtures is the quantile 1 / this over the colours of the surroundings, because of noise.
    nearest = len(off) // 20
    return float(np.partition(off, nearest)[nearest])


MIN_PLAUSIBILITY: Final = 0.1
"""Blobs with a lower plausibility are not reported."""
MIN_SOLIDITY: Final = 0.5
"""Smallest ratio of a blob's area to that of its convex hull."""
MIN_FILL: Final = 0.5
"""Smallest share of a blob's pixels with the marker's own colour; holes may be highlights."""
_TYPICAL_SOLIDITY: Final = 0.85
"""Solidity of a convex blob: a mask of pixels never fills its hull completely; chosen."""
_MAX_FAINT_ADJACENCY: Final = 0.1
"""The same for a faint blob: the seam between another paint and skin has mixed colours that belong to neither."""
_CLING_RATIO: Final = 1.5
"""Ratio of areas from which the other blob is larger; chosen."""
_LEAST_BESIDE_PX: Final = 4
"""Neighbours are examined if at least this many pixels near a blob belong to other markers."""
_BOX_3: Final = np.ones((3, 3), np.uint8)


Reason = Literal[
    "too small",
    "too large",
    "irregular",
    "mixed colours",
    "thin",
    "edge",
    "unlikely",
    "clipped",
    "too large for hand",
    "apart from skin",
    "behind the wrist",
]
"""Why a blob is no candidate: area outside the marker's limits; low solidity; few pixels of the marker's own colour; no
core; edge of a larger blob of another marker, or mixture of that one with its surroundings; plausibility 0; not
completely inside the searched region; much larger than the hand's scale permits; no skin around it, though the hand's
other fingertips adjoin skin; further behind the patch than the wrist."""


class Candidate(NamedTuple):
    """A blob that can be a marker.

    Attributes:
        blob: the blob.
        plausibility: 0 to 1; determines which blob is chosen, and whether any is.
        evidence: for its score, without tracks and other blobs.
        fill: share of its pixels with the marker's own colour.
    """

    blob: Blob
    plausibility: float
    evidence: Evidence
    fill: float


class Refusal(NamedTuple):
    """A rejected blob.

    Attributes:
        blob: the blob.
        reason: the first that applied; later criteria were not evaluated.
        fill: share of its pixels with the marker's own colour; NaN if it was not computed.
    """

    blob: Blob
    reason: Reason
    fill: float = math.nan


def without(
    refused: Sequence[Candidate],
    candidates: Mapping[str, list[Candidate]],
    judged: list[tuple[str, Candidate | Refusal]],
    reason: Reason,
) -> Mapping[str, list[Candidate]]:
    """Return the candidates without some of them, which become refusals in `judged`; empty markers are left out."""
    if not refused:
        return candidates
    blobs = {id(one.blob) for one in refused}
    for number, (name, one) in enumerate(judged):
        if isinstance(one, Candidate) and id(one.blob) in blobs:
            judged[number] = name, Refusal(one.blob, reason, one.fill)
    fits = {name: [one for one in each if id(one.blob) not in blobs] for name, each in candidates.items()}
    return {name: each for name, each in fits.items() if each}


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
    """Return a blob as candidate for a marker, or the reason for its rejection.

    Args:
        cutouts: in which it was found.
        blob: the blob.
        label: of the marker.
        least_px: smallest area of the marker, square pixels.
        track: of the marker.
        alone: whether it is the only blob; its plausibility may then be a lower bound if that is sufficient.
        faint: whether it was found by faint colours; then its pixels of typical colour determine its plausibility.
    """
    window = blob.cut
    own, own_pixels = blob.seen, int(blob.area)
    if blob.has_holes:
        own = cutouts.own[window] & blob.seen
        own_pixels = cv2.countNonZero(own)
    fill = own_pixels / max(blob.area, 1.0)
    if fill < MIN_FILL:
        return Refusal(blob, "mixed colours", fill)
    # A thin line or a ring is the edge of another marker, not paint, unless the marker was just here and is being
    # occluded.
    thin = not _has_core(blob, own, own_pixels)
    if thin and not track.continues(*blob.middle):
        return Refusal(blob, "thin", fill)
    # Largest share of the ring around a blob that a larger blob of another marker may occupy; chosen.
    adjacency = 0.4
    larger = _CLING_RATIO * blob.area
    if faint:
        typical = cv2.countNonZero(cutouts.typical[window] & own)
        adjacency, larger = _MAX_FAINT_ADJACENCY, _CLING_RATIO * typical
    if _is_rim(cutouts, blob, label, adjacency, larger):
        return Refusal(blob, "edge", fill)
    if faint:
        # Smallest number of pixels of typical colour in a faint blob, as a share of the marker's smallest
        # area; with fewer, it may be a mixture of two other colours.
        least_typical = 0.5 * least_px
        colour = typical / (typical + least_typical) if typical >= least_typical else 0.0
    else:
        # Mean of exp(−d²/2) over samples of a three-dimensional normal distribution: 2^(−3/2).
        colour = min(1.0, cv2.mean(cutouts.likelihoods[window], own)[0] / (255.0 * 0.35))
    size = blob.area / (blob.area + least_px)
    # No pixel of a blob without core is pure paint.
    # Factor on the plausibility of a blob without core; chosen.
    pure = colour * (0.5 if thin else 1.0)
    convex = pure * size * (1.0 - blob.border_share)
    # The lower bound avoids computing the convex hull, which is slow.
    solidity = blob.box_fill
    plausibility = convex * min(1.0, solidity / _TYPICAL_SOLIDITY)
    if not alone or solidity < MIN_SOLIDITY or plausibility < MIN_PLAUSIBILITY:
        solidity = blob.solidity
        plausibility = convex * min(1.0, solidity / _TYPICAL_SOLIDITY)
    if solidity < MIN_SOLIDITY:
        return Refusal(blob, "irregular", fill)
    if plausibility <= 0.0:
        return Refusal(blob, "unlikely", fill)
    if faint and blob.seen.shape == blob.mask.shape:
        # The painted share of mixed pixels is measured relative to pure paint, so the mask must not contain them.
        blob = blob._replace(mask=255 * (cutouts.typical[window] & own))
    return Candidate(blob, plausibility, Evidence(math.log(pure), -blob.border_share, 0.0), fill)


def _is_rim(cutouts: Cutouts, blob: Blob, label: int, adjacency: float, larger: float) -> bool:
    """Return whether a blob is the edge of another marker, or a seam between that marker and its surroundings.

    Args:
        cutouts: in which it was found.
        blob: the blob.
        label: of its marker.
        adjacency: largest permitted share of a larger marker in the ring around it.
        larger: number of pixels from which another marker is larger.
    """
    if cutouts.foreign_pixels < _LEAST_BESIDE_PX or cutouts.foreign_in(blob.cut) < _LEAST_BESIDE_PX:
        return False
    beside = neighbour_of(blob, cutouts.labels[blob.cut], label)
    if beside.share > adjacency and beside.pixels > larger:
        return True
    return beside.share > _MAX_FAINT_ADJACENCY and is_mixture(blob, beside, cutouts.pixels[blob.cut])


def track_plausibility(candidate: Candidate, track: MarkerTrack) -> float:
    """Return a candidate's plausibility times its agreement with the marker's track."""
    blob = candidate.blob
    return candidate.plausibility * track.preference(*blob.middle, blob.area)


def likeliest(candidates: Sequence[Candidate], track: MarkerTrack, usual_px: float = math.inf) -> Candidate | None:
    """Return the most plausible candidate for a marker; None if none is plausible enough.

    Args:
        candidates: for the marker, at least one.
        track: of that marker.
        usual_px: area of the completely visible marker, square pixels; larger blobs get no more weight.
    """
    best = candidates[0]
    if len(candidates) > 1:
        weights = [track_plausibility(one, track) * min(one.blob.area, usual_px) for one in candidates]
        first, second = sorted(range(len(candidates)), key=weights.__getitem__, reverse=True)[:2]
        share = weights[first] / (weights[first] + weights[second])
        best = candidates[first]
        best = best._replace(
            plausibility=best.plausibility * share, evidence=best.evidence._replace(alone=math.log(share))
        )
    return best if best.plausibility >= MIN_PLAUSIBILITY else None


def _has_core(blob: Blob, own: ImageArray, own_pixels: int) -> bool:
    """Return whether some pixel of a blob has all eight neighbours in it; `own` is nonzero in its `own_pixels`."""
    # Without holes, a blob with more than two pixels per point of its outline always has a core.
    if own_pixels == blob.area and own_pixels > 2 * sum(map(len, blob.contours)):
        return True
    return cv2.countNonZero(cv2.erode(own, _BOX_3, borderType=cv2.BORDER_CONSTANT, borderValue=0)) > 0
