"""All markers of a frame in one pass.

Each frame is classified as a whole by one table look-up, so a lost marker is found again wherever it turns up;
where a marker was before only decides between several blobs of its colour.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Final

import cv2
import numpy as np
from numpy.typing import NDArray

from rhot.errors import ConfigError
from rhot.rig.config import MarkerConfig
from rhot_capture.blob import Blob, find_blobs, label_regions
from rhot_capture.color_table import ColorTable, ImageArray
from rhot_capture.corners import find_corners
from rhot_capture.subpixel import centre_of, coverage
from rhot_capture.track import MarkerTrack

FloatArray = NDArray[np.float64]

MIN_SCORE: Final = 0.1
"""A blob that is less surely a marker than this is not reported."""

_TYPICAL_LIKELIHOOD: Final = 0.35
"""Mean of exp(−d²/2) over samples of a three-dimensional normal distribution: 2^(−3/2)."""
_TYPICAL_SOLIDITY: Final = 0.85
_MIN_SOLIDITY: Final = 0.5
_MIN_FILL: Final = 0.5
_MAX_ADJACENCY: Final = 0.4
_CLING_RATIO: Final = 1.5
_SLIVER_SCORE: Final = 0.5
_BOX_3: Final = np.ones((3, 3), np.uint8)
_BOX_5: Final = np.ones((5, 5), np.uint8)


@dataclass(frozen=True, slots=True)
class Detection:
    """One marker in one frame.

    Attributes:
        u, v: sub-pixel centre of the visible painted area, pixels, pixel centres on integers.
        area: visible painted area, square pixels.
        score: 0 to 1, how surely this is the marker: the product of how typical its colour is, how compact it is,
            how far it is above the smallest size, how much of it lies inside the image, and its share against a
            second blob of the same colour.
        corners: (4, 2) of a patch, pixels, clockwise as seen; None when they could not be found.
        outline: (n, 2) pixels on the rim of the painted area.
    """

    u: float
    v: float
    area: float
    score: float
    corners: FloatArray | None
    outline: FloatArray


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
        self._labels: ImageArray = np.zeros(self._size, np.uint8)
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
        return self._labels

    def reset(self) -> None:
        """Forget where the markers were."""
        self._tracks = {name: MarkerTrack() for name in self._markers}

    def detect(self, image: ImageArray) -> dict[str, Detection]:
        """Return the markers seen in a frame; one that is not seen is absent.

        Args:
            image: (H, W, 3) uint8 BGR.

        Raises:
            ConfigError: the frame is not of the detector's size.
        """
        if image.shape != (*self._size, 3) or image.dtype != np.uint8:
            raise ConfigError(
                f"frame is {image.shape} {image.dtype}, the detector was made for {(*self._size, 3)} uint8; "
                "set width and height of the camera in rig.toml to what it delivers"
            )
        raw, packed = self._table.classify(image)
        # Single wrong pixels go; a label wins a pixel only where its neighbours carry it too.
        self._labels = np.asarray(cv2.medianBlur(raw, 3), dtype=np.uint8)
        regions = label_regions(self._labels, len(self._markers))
        found = {}
        for label, (name, marker) in enumerate(self._markers.items(), start=1):
            if label not in regions:
                self._tracks[name].miss()
                continue
            blobs = find_blobs(self._labels, label, marker.min_area_px, marker.max_area_px, regions[label])
            detection = self._choose(image, packed, label, marker, blobs, self._tracks[name])
            if detection is not None:
                found[name] = detection
        return found

    def _choose(
        self,
        image: ImageArray,
        packed: NDArray[np.uint16],
        label: int,
        marker: MarkerConfig,
        blobs: Sequence[Blob],
        track: MarkerTrack,
    ) -> Detection | None:
        """Measure the blob that is most surely the marker; None when none is surely enough."""
        candidates = []
        for blob in blobs:
            score = self._score(blob, packed, label, marker, track.continues(*_middle(blob)))
            if score > 0.0:
                candidates.append((score * track.preference(*_middle(blob), blob.area) * blob.area, score, blob))
        if not candidates:
            track.miss()
            return None
        candidates.sort(key=lambda candidate: candidate[0], reverse=True)
        preference, score, blob = candidates[0]
        if len(candidates) > 1:
            score *= preference / (preference + candidates[1][0])
        if score < MIN_SCORE:
            track.miss()
            return None
        detection = _measure(image, blob, score, marker)
        track.hit(detection.u, detection.v, detection.area)
        return detection

    def _score(self, blob: Blob, packed: NDArray[np.uint16], label: int, marker: MarkerConfig, expected: bool) -> float:
        """How surely a blob is its marker, 0 to 1; 0 = it is not.

        Args:
            blob: to judge.
            packed: colours of the frame as of `ColorTable.classify`.
            label: of the marker.
            marker: its size gate.
            expected: the marker was just here, so that a sliver of it is believed.
        """
        if blob.solidity < _MIN_SOLIDITY:
            return 0.0
        labels = self._labels[blob.window]
        own = cv2.bitwise_and(cv2.inRange(labels, label, label), blob.mask)
        own_pixels = cv2.countNonZero(own)
        # A thin line or a ring is the mixed rim of another marker, not paint of its own; unless the marker was just
        # here and is being covered.
        thin = cv2.countNonZero(cv2.erode(own, _BOX_3)) == 0
        if own_pixels < _MIN_FILL * blob.area or (thin and not expected):
            return 0.0
        if self._clings(blob, labels, label):
            return 0.0
        likelihoods = cv2.LUT(packed[blob.window], self._table.likelihoods)
        colour = cv2.mean(likelihoods, own)[0] / (255.0 * _TYPICAL_LIKELIHOOD)
        compact = blob.solidity / _TYPICAL_SOLIDITY
        size = blob.area / (blob.area + marker.min_area_px)
        whole = _SLIVER_SCORE if thin else 1.0
        return whole * min(1.0, colour) * min(1.0, compact) * size * (1.0 - blob.border_share)

    def _clings(self, blob: Blob, labels: ImageArray, label: int) -> bool:
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


def _measure(image: ImageArray, blob: Blob, score: float, marker: MarkerConfig) -> Detection:
    share = coverage(image[blob.window], blob.mask)
    centre = centre_of(share, round_part=marker.kind == "cap")
    corners = find_corners(share, blob.mask) if marker.kind == "patch" and blob.border_share == 0.0 else None
    if corners is not None:
        corners += np.array([blob.x0, blob.y0])
        corners.setflags(write=False)
    outline = np.concatenate(blob.outlines).reshape(-1, 2).astype(np.float64)
    outline.setflags(write=False)
    return Detection(blob.x0 + centre.u, blob.y0 + centre.v, centre.area, score, corners, outline)
