"""Scale of each hand in the image, estimated from its markers; rejects larger objects of a paint's colour.

All markers of a hand are at a similar distance from the camera, so a square metre of paint covers about the same number
of pixels. Paint that is seen obliquely or partly occluded covers fewer pixels, never more.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Final

from rhot.rig.config import MarkerConfig
from rhot.rig.marker_config import unshared_paints
from rhot_capture.detection.candidates import MIN_PLAUSIBILITY, Candidate, Refusal, track_plausibility, without
from rhot_capture.detection.track import MarkerTrack

_MOST: Final = 4.0
"""Largest area of a marker, as a multiple of the area implied by its size and the hand's scale. A thumb's cap is 1.7
times that of a finger; a fingertip 10 cm nearer than the palm at 50 cm appears 1.6 times as large. Chosen."""
_FEWEST: Final = 4
"""Number of visible markers required to estimate the scale: of a fist, only the patch and slivers are visible.
Chosen."""
_MEMORY: Final = 0.999
"""Decay of the scale per frame with that many markers: half in 700 frames. It is slow so that a hand with partly
occluded tips keeps the scale of the open hand."""


class HandScale:
    """Scale of each hand in one camera, pixels per square metre of paint.

    Args:
        markers: of the rig, by name. Balls, whose size is unknown, and paints of both hands, which do not identify the
            hand, are not used.
    """

    def __init__(self, markers: Mapping[str, MarkerConfig]) -> None:
        # Hand and area of the paint by marker.
        self._face_m2: dict[str, tuple[str, float]] = {}
        for name in unshared_paints(markers):
            marker = markers[name]
            if marker.kind != "ball":
                # Visible paint of a fingertip seen from the side, square metres: 15 mm across, 18 mm
                # along.
                face_m2 = 2.7e-4 if marker.size_m is None else marker.size_m[0] * marker.size_m[1]
                self._face_m2[name] = marker.hand, face_m2
        self._scale = {hand: 0.0 for hand, _ in self._face_m2.values()}

    def clear(self) -> None:
        """Discard the scales."""
        self._scale = dict.fromkeys(self._scale, 0.0)

    def fitting(
        self,
        candidates: Mapping[str, list[Candidate]],
        tracks: Mapping[str, MarkerTrack],
        judged: list[tuple[str, Candidate | Refusal]],
    ) -> Mapping[str, list[Candidate]]:
        """Update the scales from the candidates of a frame, and return those that are not too large for their hand.

        A hand's scale is the second largest of its markers', so that one object of a paint's colour does not change it.

        Args:
            candidates: by marker.
            tracks: of the markers.
            judged: name and verdict of every blob; rejected candidates are replaced by refusals.
        """
        self._update(candidates, tracks)
        most_px = {name: _MOST * self.usual_px(name) for name in candidates}
        large = [one for name, each in candidates.items() for one in each if one.blob.area > most_px[name]]
        return without(large, candidates, judged, "too large for hand")

    def usual_px(self, name: str) -> float:
        """Return the area of a completely visible marker, square pixels; infinite if unknown."""
        if name not in self._face_m2:
            return math.inf
        hand, face_m2 = self._face_m2[name]
        return face_m2 * self._scale[hand] or math.inf

    def _update(self, candidates: Mapping[str, list[Candidate]], tracks: Mapping[str, MarkerTrack]) -> None:
        scales: dict[str, list[float]] = {hand: [] for hand in self._scale}
        for name, (hand, face_m2) in self._face_m2.items():
            if name in candidates:
                each, track = candidates[name], tracks[name]
                likely = each[0] if len(each) == 1 else max(each, key=lambda one: track_plausibility(one, track))
                if likely.plausibility >= MIN_PLAUSIBILITY:
                    scales[hand].append(likely.blob.area / face_m2)
        for hand, seen in scales.items():
            kept = self._scale[hand]
            # Growth of the scale per frame with fewer: a fist may come nearer, from 90 to 43 cm within a
            # second. Chosen.
            self._scale[hand] = max(_MEMORY * kept, sorted(seen)[-2]) if len(seen) >= _FEWEST else 1.005 * kept
