"""All markers of a frame in one pass.

While every marker is where it was expected, only the places where they are expected are looked at. As soon as one is
not there, and every `_SURVEY_FRAMES` frames anyway, the whole frame is searched for places, so a lost marker is found
again wherever it turns up; where a marker was before only decides between several blobs of its colour. Either way all
places are classified together and measured alike.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Final, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from rhot.errors import ConfigError
from rhot.rig.config import MarkerConfig
from rhot_capture.blob import Blob, blobs_of
from rhot_capture.color_table import ColorTable, ImageArray
from rhot_capture.corners import find_corners
from rhot_capture.cutouts import Cutouts, Region
from rhot_capture.grids import Window
from rhot_capture.score import Evidence, probability
from rhot_capture.search import find_regions
from rhot_capture.subpixel import find_centres
from rhot_capture.track import MarkerTrack

FloatArray = NDArray[np.float64]

MIN_PLAUSIBILITY: Final = 0.1
"""A blob that is less like a marker than this is not reported."""

_TYPICAL_LIKELIHOOD: Final = 0.35
"""Mean of exp(−d²/2) over samples of a three-dimensional normal distribution: 2^(−3/2)."""
_TYPICAL_SOLIDITY: Final = 0.85
_MIN_SOLIDITY: Final = 0.5
_MIN_FILL: Final = 0.5
_MAX_ADJACENCY: Final = 0.4
_CLING_RATIO: Final = 1.5
_SLIVER_SCORE: Final = 0.5
_SURVEY_FRAMES: Final = 30
_BOX_3: Final = np.ones((3, 3), np.uint8)
_BOX_5: Final = np.ones((5, 5), np.uint8)


@dataclass(frozen=True, slots=True)
class Detection:
    """One marker in one frame.

    Attributes:
        u, v: sub-pixel centre of the visible painted area, pixels, pixel centres on integers.
        area: visible painted area, square pixels.
        score: the probability that this is the marker and its centre within a pixel of the truth; see
            `rhot_capture.score`.
        corners: (4, 2) of a patch, pixels, clockwise as seen; None when they could not be found.
        blob: the painted area.
    """

    u: float
    v: float
    area: float
    score: float
    corners: FloatArray | None
    blob: Blob

    @property
    def outline(self) -> FloatArray:
        """(n, 2) pixels on the rim of the painted area."""
        return np.concatenate(self.blob.outlines).reshape(-1, 2).astype(np.float64)


class _Candidate(NamedTuple):
    """A blob that may be a marker.

    Attributes:
        blob: where it is.
        plausibility: 0 to 1, how much it is like the marker; decides which blob is chosen and whether one is.
        evidence: for its score, but for what tracks and other blobs tell.
    """

    blob: Blob
    plausibility: float
    evidence: Evidence


class MarkerDetector:
    """Finds all markers of one camera, frame after frame."""

    def __init__(self, markers: Mapping[str, MarkerConfig], table: ColorTable, width: int, height: int) -> None:
        """Prepare for frames of one size.

        Args:
            markers: by name.
            table: built for these markers, in this order.
            width: of the frames, pixels.
            height: of the frames, pixels.

        Raises:
            ConfigError: the table was built for other markers.
        """
        self._markers = dict(markers)
        self._names = tuple(markers)
        self._size = (height, width)
        self._tracks = {name: MarkerTrack() for name in markers}
        self._image: ImageArray = np.zeros((height, width, 3), np.uint8)
        self._since_survey = 0
        self.table = table

    @property
    def table(self) -> ColorTable:
        """The colours in use; may be replaced between frames."""
        return self._table

    @table.setter
    def table(self, table: ColorTable) -> None:
        if table.names != tuple(self._markers):
            raise ConfigError(
                f"colour table is for {', '.join(table.names)}, the detector looks for {', '.join(self._markers)}"
            )
        self._table = table

    @property
    def labels(self) -> ImageArray:
        """Labels of the last frame, (H, W) uint8, 0 = no marker, i = the i-th marker."""
        labels, _ = self._table.classify(self._image)
        return np.asarray(cv2.medianBlur(labels, 3), dtype=np.uint8)

    def reset(self) -> None:
        """Forget where the markers were."""
        self._tracks = {name: MarkerTrack() for name in self._markers}

    def detect(self, image: ImageArray) -> dict[str, Detection]:
        """Return the markers seen in a frame; one that is not seen is absent.

        Args:
            image: (H, W, 3) uint8 BGR; kept until the next frame for `labels`.

        Raises:
            ConfigError: the frame is not of the detector's size.
        """
        if image.shape != (*self._size, 3) or image.dtype != np.uint8:
            raise ConfigError(
                f"frame is {image.shape} {image.dtype}, the detector was made for {(*self._size, 3)} uint8; "
                "set width and height of the camera in rig.toml to what it delivers"
            )
        self._image = image
        chosen = self._follow()
        if chosen is None:
            chosen = self._survey()
        for name in self._markers:
            if name not in chosen:
                self._tracks[name].miss()
        return self._measure(image, chosen)

    def _follow(self) -> dict[str, _Candidate] | None:
        """Look for each marker where it is expected; None when one of them is not wholly there."""
        self._since_survey += 1
        if self._since_survey >= _SURVEY_FRAMES:
            return None
        looks: list[tuple[int, Region]] = []
        for label, track in enumerate(self._tracks.values(), start=1):
            region = track.region(track.margin_px, *self._size)
            if region is None:
                return None
            looks.append((label, region))
        candidates = self._candidates(looks, every=True) if looks else {}
        if candidates is None or len(candidates) < len(looks):
            return None
        chosen = self._best(candidates)
        return chosen if len(chosen) == len(looks) else None

    def _survey(self) -> dict[str, _Candidate]:
        """Look for every marker in the whole frame."""
        self._since_survey = 0
        looks = find_regions(self._image, self._table)
        return self._best(self._candidates(looks, every=False) or {}) if looks else {}

    def _candidates(self, looks: Sequence[tuple[int, Region]], every: bool) -> dict[str, list[_Candidate]] | None:
        """Return the candidates for each marker in some regions of the frame; markers without one are absent.

        Args:
            looks: label and region.
            every: return None as soon as some blob is not wholly in its region.
        """
        cutouts = Cutouts(self._image, self._table, looks)
        markers = [self._markers[self._names[label - 1]] for label, _ in looks]
        gates = [(marker.min_area_px, marker.max_area_px) for marker in markers]
        candidates: dict[str, list[_Candidate]] = {}
        found = blobs_of(cutouts.own, cutouts.places, gates, self._size)
        for place, marker, blobs in zip(cutouts.places, markers, found, strict=True):
            name = self._names[place.label - 1]
            for blob in blobs:
                if not blob.inside(place.region, self._size):
                    if every:
                        return None
                    continue
                candidate = self._judge(cutouts, blob, place.label, marker, self._tracks[name])
                if candidate is not None:
                    candidates.setdefault(name, []).append(candidate)
        return candidates

    def _judge(
        self, cutouts: Cutouts, blob: Blob, label: int, marker: MarkerConfig, track: MarkerTrack
    ) -> _Candidate | None:
        """Return a blob as candidate for a marker; None when it is none."""
        if blob.solidity < _MIN_SOLIDITY:
            return None
        window = blob.cut
        labels = cutouts.labels[window]
        own = cutouts.own[window] & blob.mask
        own_pixels = cv2.countNonZero(own)
        if own_pixels < _MIN_FILL * blob.area:
            return None
        # A thin line or a ring is the mixed rim of another marker, not paint of its own; unless the marker was just
        # here and is being covered.
        thin = _is_thin(blob, own, own_pixels)
        if thin and not track.continues(*_middle(blob)):
            return None
        if cv2.countNonZero(labels) > own_pixels and _clings(blob, labels, label):
            return None
        likelihoods = cv2.LUT(cutouts.packed[window], self._table.likelihoods)
        colour = min(1.0, cv2.mean(likelihoods, own)[0] / (255.0 * _TYPICAL_LIKELIHOOD))
        compact = min(1.0, blob.solidity / _TYPICAL_SOLIDITY)
        size = blob.area / (blob.area + marker.min_area_px)
        # A sliver is all rim: none of its pixels is pure paint.
        pure = colour * (_SLIVER_SCORE if thin else 1.0)
        plausibility = pure * compact * size * (1.0 - blob.border_share)
        if plausibility <= 0.0:
            return None
        evidence = Evidence(colour=math.log(pure), inside=-blob.border_share, alone=0.0)
        return _Candidate(blob, plausibility, evidence)

    def _best(self, candidates: Mapping[str, list[_Candidate]]) -> dict[str, _Candidate]:
        """Return for each marker the candidate that is most surely it; none where none is surely enough."""
        chosen: dict[str, _Candidate] = {}
        for name in self._names:
            each = candidates.get(name)
            if each is None:
                continue
            best = each[0]
            if len(each) > 1:
                track = self._tracks[name]
                # How much it is like the marker, times how well it continues the track, times area.
                weights = [
                    one.plausibility * track.preference(*_middle(one.blob), one.blob.area) * one.blob.area
                    for one in each
                ]
                first, second = sorted(range(len(each)), key=weights.__getitem__, reverse=True)[:2]
                share = weights[first] / (weights[first] + weights[second])
                best = each[first]
                best = best._replace(
                    plausibility=best.plausibility * share, evidence=best.evidence._replace(alone=math.log(share))
                )
            if best.plausibility >= MIN_PLAUSIBILITY:
                chosen[name] = best
        return chosen

    def _measure(self, image: ImageArray, chosen: Mapping[str, _Candidate]) -> dict[str, Detection]:
        """Measure the chosen blobs of a frame."""
        windows = []
        for name, one in chosen.items():
            blob, is_cap = one.blob, self._markers[name].kind == "cap"
            # At the picture's border a rim is missing, and what the gain does on the other side would not cancel.
            whole = blob.border_share == 0.0
            windows.append(Window(image[blob.window], blob.mask, is_cap and whole, not is_cap and whole))
        found = {}
        for (name, one), centre in zip(chosen.items(), find_centres(windows), strict=True):
            blob = one.blob
            corners = None
            if centre.share is not None:
                corners = find_corners(centre.share, blob.mask)
            if corners is not None:
                corners += (blob.x0, blob.y0)
                corners.setflags(write=False)
            u, v = blob.x0 + centre.u, blob.y0 + centre.v
            found[name] = Detection(u, v, centre.area, probability(one.evidence), corners, blob)
            self._tracks[name].hit(u, v, centre.area, 0.5 * max(blob.mask.shape))
        return found


def _is_thin(blob: Blob, own: ImageArray, own_pixels: int) -> bool:
    """Tell whether no pixel of a blob has all its eight neighbours in it.

    Args:
        blob: it.
        own: (h, w) uint8, 1 where its pixels have its own label.
        own_pixels: how many.
    """
    # Without holes, what is thin is all outline and the inner corners of the outline, at most as many again.
    if own_pixels == blob.area and own_pixels > 2 * sum(map(len, blob.contours)):
        return False
    return cv2.countNonZero(cv2.erode(own, _BOX_3)) == 0


def _clings(blob: Blob, labels: ImageArray, label: int) -> bool:
    """Tell whether a blob hangs on a larger blob of another marker, as the stained rim of that marker does."""
    ring = labels[(cv2.dilate(blob.mask, _BOX_5) > 0) & (blob.mask == 0)]
    counts = np.bincount(ring, minlength=label + 1)
    counts[0] = counts[label] = 0
    other = int(np.argmax(counts))
    if counts[other] <= _MAX_ADJACENCY * len(ring):
        return False
    return bool(np.count_nonzero(labels == other) > _CLING_RATIO * blob.area)


def _middle(blob: Blob) -> tuple[float, float]:
    height, width = blob.mask.shape
    return blob.x0 + 0.5 * (width - 1), blob.y0 + 0.5 * (height - 1)
