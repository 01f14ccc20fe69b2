"""How large the markers of a hand can be in a picture, by each other: what tells an object of a paint's colour.

Markers of one hand are about as far from the camera as each other, so each square metre of paint covers about as many
pixels. Bent away or half hidden, paint covers fewer, never more. What covers many more is not on this hand.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Final

from rhot.rig.config import MarkerConfig
from rhot.rig.marker_config import unshared_paints
from rhot_capture.detection.candidates import MIN_PLAUSIBILITY, Candidate, Refusal, continuing
from rhot_capture.detection.track import MarkerTrack

_CAP_M2: Final = 2.7e-4
"""Paint of a fingertip that a camera sees from the side, square metres: 15 mm across, 18 mm along."""
_MOST: Final = 4.0
"""How many times the pixels a marker may have that its size and the hand's scale say. A thumb's cap is 1.7 times that
of a finger, a fingertip 10 cm nearer than the palm at 50 cm shows 1.6 times as much. Chosen."""
_FEWEST: Final = 4
"""Markers that must be seen at once to tell a hand's scale: of a fist, one sees the patch and slivers. Chosen."""
_MEMORY: Final = 0.999
"""What remains of the largest scale in a frame with so many: half of it is forgotten in 700 frames. A hand whose tips
are half hidden keeps the scale that it had when it was open."""
_NEARER: Final = 1.005
"""How much it grows in a frame with fewer: a fist may come nearer, from 90 to 43 cm within a second. Chosen."""


class HandScale:
    """Pixels to each square metre of paint, for each hand in one camera's pictures.

    Args:
        markers: of the rig, by name. Balls are of any size, and paint that two hands wear may be on either; both are
            left out.
    """

    def __init__(self, markers: Mapping[str, MarkerConfig]) -> None:
        # By marker its hand and the area of its paint.
        self._face_m2: dict[str, tuple[str, float]] = {}
        for name in unshared_paints(markers):
            marker = markers[name]
            if marker.kind != "ball":
                face_m2 = _CAP_M2 if marker.size_m is None else marker.size_m[0] * marker.size_m[1]
                self._face_m2[name] = marker.hand, face_m2
        self._scale = {hand: 0.0 for hand, _ in self._face_m2.values()}

    def clear(self) -> None:
        """Forget the scales."""
        self._scale = dict.fromkeys(self._scale, 0.0)

    def fitting(
        self,
        candidates: Mapping[str, list[Candidate]],
        tracks: Mapping[str, MarkerTrack],
        judged: list[tuple[str, Candidate | Refusal]],
    ) -> Mapping[str, list[Candidate]]:
        """Return the candidates of one frame that are not too large for their hand, whose scale is learnt from them.

        The second largest scale among its markers counts: one object of a paint's colour does not make a hand larger.

        Args:
            candidates: by marker.
            tracks: of the markers.
            judged: name and verdict of every blob; candidates that are left out become refusals.
        """
        self._learn(candidates, tracks)
        most_px = {name: _MOST * self.usual_px(name) for name in candidates}
        # In most frames this is all.
        if all(one.blob.area <= most_px[name] for name, each in candidates.items() for one in each):
            return candidates
        for number, (name, one) in enumerate(judged):
            if isinstance(one, Candidate) and one.blob.area > most_px[name]:
                judged[number] = name, Refusal(one.blob, "outsized", one.fill)
        fits = {name: [one for one in each if one.blob.area <= most_px[name]] for name, each in candidates.items()}
        return {name: each for name, each in fits.items() if each}

    def usual_px(self, name: str) -> float:
        """Return the square pixels of a marker that is wholly seen; infinite where nothing tells."""
        if name not in self._face_m2:
            return math.inf
        hand, face_m2 = self._face_m2[name]
        return face_m2 * self._scale[hand] or math.inf

    def _learn(self, candidates: Mapping[str, list[Candidate]], tracks: Mapping[str, MarkerTrack]) -> None:
        scales: dict[str, list[float]] = {hand: [] for hand in self._scale}
        for name, (hand, face_m2) in self._face_m2.items():
            if name in candidates:
                each, track = candidates[name], tracks[name]
                likely = each[0] if len(each) == 1 else max(each, key=lambda one: continuing(one, track))
                if likely.plausibility >= MIN_PLAUSIBILITY:
                    scales[hand].append(likely.blob.area / face_m2)
        for hand, seen in scales.items():
            kept = self._scale[hand]
            self._scale[hand] = max(_MEMORY * kept, sorted(seen)[-2]) if len(seen) >= _FEWEST else _NEARER * kept
