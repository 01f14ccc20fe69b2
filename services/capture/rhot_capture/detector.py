"""All markers of a frame in one pass.

While every marker is where it was expected, only the part of the frame that holds them is classified. As soon as one
is not, and every `_SURVEY_FRAMES` frames anyway, the same look-up runs over the whole frame, so a lost marker is found
again wherever it turns up; where a marker was before only decides between several blobs of its colour.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Final

import cv2
import numpy as np
from numpy.typing import NDArray

from rhot.errors import ConfigError
from rhot.rig.config import MarkerConfig
from rhot_capture.blob import PADDING_PX, Blob, Region, find_blobs, label_regions
from rhot_capture.color_table import ColorTable, ImageArray
from rhot_capture.corners import find_corners
from rhot_capture.score import Evidence, probability
from rhot_capture.subpixel import Window, find_centres
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
_REGION_MARGIN_PX: Final = 24.0
"""Around where a marker is expected: a tip at 1.5 m/s moves 17 pixels in a frame of 1/60 s, 80 cm away."""
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
        outline: (n, 2) pixels on the rim of the painted area.
    """

    u: float
    v: float
    area: float
    score: float
    corners: FloatArray | None
    outline: FloatArray


@dataclass(frozen=True, slots=True)
class _Candidate:
    """A blob that may be a marker.

    Attributes:
        blob: where it is.
        plausibility: 0 to 1, how much it is like the marker; decides which blob is chosen and whether one is.
        evidence: for its score, but for what tracks and other blobs tell.
        weight: plausibility, times how well it continues the track, times area.
    """

    blob: Blob
    plausibility: float
    evidence: Evidence
    weight: float


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
        self._size = (height, width)
        self._tracks = {name: MarkerTrack() for name in markers}
        self._image: ImageArray = np.zeros((height, width, 3), np.uint8)
        self._labels: ImageArray = np.zeros(self._size, np.uint8)
        self._packed: NDArray[np.uint16] = np.zeros((height, width, 1), np.uint16)
        self._complete = True
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
        self._classify((0, 0, self._size[1], self._size[0]))
        return self._labels

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
        self._complete = False
        chosen = self._follow()
        if chosen is None:
            chosen = self._survey()
        for name in self._markers:
            if name not in chosen:
                self._tracks[name].miss()
        return self._measure(image, chosen)

    def _classify(self, area: Region) -> None:
        """Label a part of the frame."""
        if self._complete:
            return
        left, top, right, bottom = area
        rows, columns = slice(top, bottom), slice(left, right)
        labels, self._packed[rows, columns] = self._table.classify(self._image[rows, columns])
        # Single wrong pixels go; a label wins a pixel only where its neighbours carry it too.
        self._labels[rows, columns] = cv2.medianBlur(labels, 3)
        self._complete = (bottom - top, right - left) == self._size

    def _follow(self) -> dict[str, _Candidate] | None:
        """Look for each marker where it is expected; None when one of them is not wholly there."""
        self._since_survey += 1
        if self._since_survey >= _SURVEY_FRAMES:
            return None
        regions: dict[str, Region] = {}
        for name, track in self._tracks.items():
            region = track.region(_REGION_MARGIN_PX, *self._size)
            if region is None:
                return None
            regions[name] = region
        lefts, tops, rights, bottoms = zip(*regions.values(), strict=True)
        self._classify(
            (
                max(0, min(lefts) - PADDING_PX),
                max(0, min(tops) - PADDING_PX),
                min(self._size[1], max(rights) + PADDING_PX),
                min(self._size[0], max(bottoms) + PADDING_PX),
            )
        )
        chosen: dict[str, _Candidate] = {}
        for label, (name, region) in enumerate(regions.items(), start=1):
            best = self._choose(label, name, region)
            if best is None or not self._within(best.blob, region):
                return None
            chosen[name] = best
        return chosen

    def _within(self, blob: Blob, region: Region) -> bool:
        """Tell whether a blob ends inside its region, but for where the picture ends."""
        height, width = blob.mask.shape
        left, top, right, bottom = region
        return (
            (blob.x0 + PADDING_PX > left or left == 0)
            and (blob.y0 + PADDING_PX > top or top == 0)
            and (blob.x0 + width - PADDING_PX < right or right == self._size[1])
            and (blob.y0 + height - PADDING_PX < bottom or bottom == self._size[0])
        )

    def _survey(self) -> dict[str, _Candidate]:
        """Look for every marker in the whole frame."""
        self._since_survey = 0
        self._classify((0, 0, self._size[1], self._size[0]))
        regions = label_regions(self._labels, len(self._markers))
        chosen: dict[str, _Candidate] = {}
        for label, name in enumerate(self._markers, start=1):
            best = self._choose(label, name, regions[label]) if label in regions else None
            if best is not None:
                chosen[name] = best
        return chosen

    def _choose(self, label: int, name: str, region: Region) -> _Candidate | None:
        """Return the blob in a region that is most surely the marker; None when none is surely enough."""
        marker, track = self._markers[name], self._tracks[name]
        blobs = find_blobs(self._labels, label, marker.min_area_px, marker.max_area_px, region)
        candidates = [found for blob in blobs if (found := self._judge(blob, label, marker, track)) is not None]
        if not candidates:
            return None
        candidates.sort(key=lambda candidate: candidate.weight, reverse=True)
        best = candidates[0]
        if len(candidates) > 1:
            share = best.weight / (best.weight + candidates[1].weight)
            best = replace(
                best, plausibility=best.plausibility * share, evidence=best.evidence._replace(alone=math.log(share))
            )
        return best if best.plausibility >= MIN_PLAUSIBILITY else None

    def _judge(self, blob: Blob, label: int, marker: MarkerConfig, track: MarkerTrack) -> _Candidate | None:
        """Return a blob as candidate for a marker; None when it is none."""
        if blob.solidity < _MIN_SOLIDITY:
            return None
        middle = _middle(blob)
        labels = self._labels[blob.window]
        own = cv2.inRange(labels, label, label)
        others = cv2.countNonZero(labels) > cv2.countNonZero(own)
        own = cv2.bitwise_and(own, blob.mask)
        own_pixels = cv2.countNonZero(own)
        # A thin line or a ring is the mixed rim of another marker, not paint of its own; unless the marker was just
        # here and is being covered.
        thin = cv2.countNonZero(cv2.erode(own, _BOX_3)) == 0
        if own_pixels < _MIN_FILL * blob.area or (thin and not track.continues(*middle)):
            return None
        if others and _clings(blob, labels, label):
            return None
        likelihoods = cv2.LUT(self._packed[blob.window], self._table.likelihoods)
        colour = min(1.0, cv2.mean(likelihoods, own)[0] / (255.0 * _TYPICAL_LIKELIHOOD))
        compact = min(1.0, blob.solidity / _TYPICAL_SOLIDITY)
        size = blob.area / (blob.area + marker.min_area_px)
        # A sliver is all rim: none of its pixels is pure paint.
        pure = colour * (_SLIVER_SCORE if thin else 1.0)
        plausibility = pure * compact * size * (1.0 - blob.border_share)
        if plausibility <= 0.0:
            return None
        evidence = Evidence(colour=math.log(pure), inside=-blob.border_share, alone=0.0)
        weight = plausibility * track.preference(*middle, blob.area) * blob.area
        return _Candidate(blob, plausibility, evidence, weight)

    def _measure(self, image: ImageArray, chosen: Mapping[str, _Candidate]) -> dict[str, Detection]:
        """Measure the chosen blobs of a frame."""
        # At the picture's border a rim is missing, and what the gain does on the other side would not cancel.
        windows = [
            Window(
                image[one.blob.window],
                one.blob.mask,
                self._markers[name].kind == "cap" and one.blob.border_share == 0.0,
            )
            for name, one in chosen.items()
        ]
        found = {}
        for (name, one), centre in zip(chosen.items(), find_centres(windows), strict=True):
            blob = one.blob
            corners = None
            if self._markers[name].kind == "patch" and blob.border_share == 0.0:
                corners = find_corners(centre.share, blob.mask)
            if corners is not None:
                corners += np.array([blob.x0, blob.y0])
                corners.setflags(write=False)
            outline = np.concatenate(blob.outlines).reshape(-1, 2).astype(np.float64)
            outline.setflags(write=False)
            u, v = blob.x0 + centre.u, blob.y0 + centre.v
            found[name] = Detection(u, v, centre.area, probability(one.evidence), corners, outline)
            self._tracks[name].hit(u, v, centre.area, 0.5 * max(blob.mask.shape))
        return found


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
