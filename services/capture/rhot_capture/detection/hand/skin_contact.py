"""Whether a blob adjoins skin, as painted fingertips do; rejects objects of a paint's colour apart from the hand.

While a fingertip is hidden, a sleeve of its colour would be taken for it, and its track would then prefer the sleeve to
the fingertip when that comes back. A blob without skin around it is therefore accepted only where the marker just was:
a finger that points at the camera hides its own skin. The rule holds only while other fingertips of the hand adjoin
skin, so that gloves and skin of an unusual colour do not matter.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping
from typing import Final

import cv2
import numpy as np

from rhot.arrays import ImageArray
from rhot.rig.config import MarkerConfig
from rhot_capture.detection.candidates import Candidate, Refusal, without
from rhot_capture.detection.color_table import pack
from rhot_capture.detection.subpixel.batch import skin_ring
from rhot_capture.detection.track import MarkerTrack

_APART: Final = 0.02
"""Largest share around a blob apart from the hand: single pixels of a room have the colour of skin. Chosen."""
_LASTS_FRAMES: Final = 30
"""For so many frames it is known of a fingertip that it adjoined skin: half a second at 60 Hz. Chosen."""
_FEWEST: Final = 2
"""Number of other fingertips that must adjoin skin. Chosen."""
_NEAR: Final = 0.5
"""Smallest agreement with the track of a blob that is where the marker just was; see `MarkerTrack.preference`."""


class SkinContact:
    """Contact of fingertips with skin in one camera.

    Args:
        markers: of the rig, by name; only fingertips are examined.
    """

    def __init__(self, markers: Mapping[str, MarkerConfig]) -> None:
        self._hand_of = {name: marker.hand for name, marker in markers.items() if marker.kind == "cap"}
        self._since = dict.fromkeys(self._hand_of, _LASTS_FRAMES)

    def clear(self) -> None:
        """Discard what is known."""
        self._since = dict.fromkeys(self._since, _LASTS_FRAMES)

    def update(self, shares: Mapping[str, float]) -> None:
        """Update with a frame: the share of skin around each marker that was detected."""
        for name, since in self._since.items():
            # Smallest share of the ring around a fingertip that is skin; 0.2 to 0.3 is usual (rendered
            # pictures). Chosen.
            self._since[name] = 0 if shares.get(name, 0.0) >= 0.05 else min(since + 1, _LASTS_FRAMES)

    def fitting(
        self,
        candidates: Mapping[str, list[Candidate]],
        tracks: Mapping[str, MarkerTrack],
        judged: list[tuple[str, Candidate | Refusal]],
        image: ImageArray,
        skin: ImageArray | None,
    ) -> Mapping[str, list[Candidate]]:
        """Return the candidates that adjoin skin or are where their marker just was.

        Args:
            candidates: by marker.
            tracks: of the markers.
            judged: name and verdict of every blob; rejected candidates are replaced by refusals.
            image: (H, W, 3) uint8 BGR.
            skin: (65536,) uint8, 1 for 5-6-5 colours of skin; None = not known.
        """
        if skin is None:
            return candidates
        adjoining = Counter(self._hand_of[name] for name, since in self._since.items() if since < _LASTS_FRAMES)
        apart = []
        for name in self._hand_of.keys() & candidates.keys():
            is_known = self._since[name] < _LASTS_FRAMES
            if adjoining[self._hand_of[name]] - is_known >= _FEWEST:
                apart += [
                    one
                    for one in candidates[name]
                    if not (is_known and _is_near(one, tracks[name]))
                    and one.blob.border_share == 0.0
                    and _skin_share(one, image, skin) < _APART
                ]
        return without(apart, candidates, judged, "apart from skin")


def _is_near(candidate: Candidate, track: MarkerTrack) -> bool:
    """Return whether a candidate is where its marker just was."""
    blob = candidate.blob
    return track.is_recent and track.preference(*blob.middle, blob.area) >= _NEAR


def _skin_share(candidate: Candidate, image: ImageArray, skin: ImageArray) -> float:
    """Return the share of the ring around a blob that is skin."""
    blob = candidate.blob
    ring = skin_ring((blob.mask > 0).view(np.uint8))
    colours = np.asarray(cv2.LUT(pack(image[blob.window]), skin), dtype=np.uint8).reshape(ring.shape)
    return cv2.countNonZero(ring & colours) / max(cv2.countNonZero(ring), 1)
