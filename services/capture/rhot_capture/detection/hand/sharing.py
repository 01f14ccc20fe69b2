"""Assign blobs of a paint that both hands have to the hands' markers.

The likelihood of a match depends on the blob's distance from the marker's predicted position: from its motion while it
is seen in every frame, afterwards from its last position relative to its hand's patch. The distance from that patch is
limited by a hand's reach. All blobs of a paint are matched jointly. Ambiguous matches are omitted, because a missing
marker is better than a swapped one.

Everything is in one camera's image, in pixels. The patches identify the hands, because each has a paint of its own.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Mapping, Sequence
from typing import Final, NamedTuple

from rhot.anatomy.markers import PaintedMarker
from rhot_capture.detection.candidates import Candidate

_REACH_M: Final = 0.20
"""Distance from the centre of a patch to the farthest fingertip: 0.165 m for an average hand (189 mm from the wrist),
up to 0.22 m for large ones (hand.length_m permits 0.26), and a tilted patch looks smaller."""
_STEP_PX: Final = 4.0
"""Standard deviation of a fingertip's prediction from its motion: 20 m/s² (the largest in the recordings) for 1/30 s
are 11 mm, 7 pixels of a camera with 0.6 pixels per millimetre (640 columns, 62°, 0.85 m)."""
_NEW: Final = math.log(0.02)
"""Log-likelihood of a marker without prediction, relative to one at its predicted position."""
_MISSING: Final = math.log(1e-5)
"""Log-likelihood of a missing marker, on the same scale: equal to that of a blob at 4.8 σ."""
_CLEAR: Final = math.log(100.0)
"""A match must be this much likelier than any that assigns the marker differently: a wrong one would persist."""


class Anchor(NamedTuple):
    """A patch in the image.

    Attributes:
        u, v: its centre, pixels.
        px_m: scale, pixels per metre.
    """

    u: float
    v: float
    px_m: float


class Spot(NamedTuple):
    """Position and size of a blob.

    Attributes:
        u, v: its centre, pixels.
        across, down: its width and height, pixels.
        area: square pixels.
        plausibility: 0 to 1, see `Candidate`.
    """

    u: float
    v: float
    across: float
    down: float
    area: float
    plausibility: float

    def contains(self, place: Prediction) -> bool:
        """Return whether a predicted position is inside its bounding rectangle."""
        return 2.0 * abs(place.u - self.u) <= self.across and 2.0 * abs(place.v - self.v) <= self.down


def spot_of(candidate: Candidate) -> Spot:
    """Return position and size of a candidate's blob."""
    u, v = candidate.blob.middle
    _, _, across, down = candidate.blob.box
    return Spot(u, v, across, down, candidate.blob.area, candidate.plausibility)


def anchor_of(spot: Spot, marker: PaintedMarker) -> Anchor:
    """Return position and scale of a patch."""
    across_m, along_m = marker.size_m or (1.0, 1.0)
    return Anchor(spot.u, spot.v, math.sqrt(spot.area / (across_m * along_m)))


class Prediction(NamedTuple):
    """Predicted position of a marker.

    Attributes:
        u, v: pixels.
        sigma_px: standard deviation of each.
    """

    u: float
    v: float
    sigma_px: float


class _Memory:
    """Last position of a marker relative to its hand's patch, pixels, and number of frames since then."""

    __slots__ = ("beside", "missed")

    def __init__(self) -> None:
        self.beside: tuple[float, float] | None = None
        self.missed = 0


class SharedPaints:
    """Assigns the blobs of shared paints to markers.

    Args:
        markers: of the rig, by name.
    """

    def __init__(self, markers: Mapping[str, PaintedMarker]) -> None:
        pairs = {marker.paint_of: name for name, marker in markers.items() if marker.paint_of is not None}
        self.wearers: dict[str, tuple[str, str]] = {paint: (paint, other) for paint, other in pairs.items()}
        shared = {name for pair in self.wearers.values() for name in pair}
        own = {m.hand: name for name, m in markers.items() if m.kind == "patch" and name not in shared}
        self._patch_of = {name: own[markers[name].hand] for name in shared}
        self.patches = {name: markers[name] for name in self._patch_of.values()}
        self._memory = {name: _Memory() for name in shared}
        self._anchors: dict[str, Anchor] = {}
        self._remembered: dict[str, Anchor] = {}
        self._unseen: dict[str, int] = {}
        self._kept_px_m = self._scale_px_m = 0.0

    def clear(self) -> None:
        """Discard all positions."""
        self._memory = {name: _Memory() for name in self._memory}
        self._anchors, self._remembered = {}, {}
        self._kept_px_m = 0.0

    def see_patches(self, found: Mapping[str, Spot]) -> None:
        """Process the patches detected in a frame; for missing ones the last position is used."""
        seen = {name: anchor_of(found[name], patch) for name, patch in self.patches.items() if name in found}
        self._anchors = self._remembered | seen
        # The larger scale is valid for both hands: they are at similar distances, and tilted patches look too small.
        self._scale_px_m = max([self._kept_px_m, *(anchor.px_m for anchor in seen.values())])

    def expected(self, name: str, carried: tuple[float, float] | None) -> Prediction | None:
        """Return the predicted position of a marker; None if there is none.

        Args:
            name: of the marker.
            carried: prediction from its motion, pixels; None if it was not in the last frame.
        """
        if carried is not None:
            return Prediction(*carried, _STEP_PX)
        memory, anchor = self._memory[name], self._anchors.get(self._patch_of[name])
        if anchor is None or memory.beside is None:
            return None
        # Increase of it per frame without the marker, because fingers move relative to the hand.
        # Upper bound of it: half of a finger's path from open to closed in such an image.
        sigma_px = min(_STEP_PX + 3.0 * memory.missed, 45.0)
        return Prediction(anchor.u + memory.beside[0], anchor.v + memory.beside[1], sigma_px)

    def match(
        self, paint: str, spots: Sequence[Spot], carried: Mapping[str, tuple[float, float] | None]
    ) -> dict[str, int]:
        """Return, by marker, the index of its blob of a shared paint; ambiguous matches are omitted.

        Args:
            paint: name of the marker that defines the paint.
            spots: blobs of this paint.
            carried: of both markers, see `expected`.
        """
        first, second = self.wearers[paint]
        places = {name: self.expected(name, carried[name]) for name in (first, second)}
        # Predictions with a smaller standard deviation are certain to a fingertip's width.
        here = [place for place in places.values() if place is not None and place.sigma_px <= 10.0]
        # Touching fingertips form one blob, which is assigned to neither.
        apart = [k for k, spot in enumerate(spots) if len(here) < 2 or not all(spot.contains(place) for place in here)]
        fits = {name: {k: self._fit(name, places[name], spots[k]) for k in apart} for name in (first, second)}
        numbers = [None, *apart]
        ranked: list[tuple[float, int | None, int | None]] = []
        for a, b in itertools.product(numbers, numbers):
            if a is not None and a == b:
                continue
            fit = (_MISSING if a is None else fits[first][a]) + (_MISSING if b is None else fits[second][b])
            ranked.append((fit, a, b))
        best, a, b = max(ranked, key=lambda each: each[0])
        found = {}
        for name, number, place in ((first, a, 1), (second, b, 2)):
            rival = max((each[0] for each in ranked if each[place] != number), default=-math.inf)
            if number is not None and best - rival >= _CLEAR:
                found[name] = number
        return found

    def remember(self, seen: Mapping[str, tuple[float, float]]) -> None:
        """Store the positions of a frame's markers and patches, u and v in pixels."""
        # Decay of the largest scale per frame. Hands that move at 1 m/s change it by at most 2 % in 1/60 s.
        # It halves in two seconds; until then a partly occluded patch does not reduce the scale.
        self._kept_px_m = 0.995 * self._scale_px_m
        for patch in self.patches:
            self._unseen[patch] = 0 if patch in seen else self._unseen.get(patch, 0) + 1
        # Number of frames for which the last position of an unseen patch is used: as long as a track is kept.
        self._remembered = {patch: anchor for patch, anchor in self._anchors.items() if self._unseen[patch] <= 10}
        for name, memory in self._memory.items():
            where, anchor = seen.get(name), self._anchors.get(self._patch_of[name])
            if where is None:
                memory.missed += 1
            elif anchor is not None:
                memory.beside, memory.missed = (where[0] - anchor.u, where[1] - anchor.v), 0

    def _fit(self, name: str, place: Prediction | None, spot: Spot) -> float:
        """Return the log-likelihood of a match, relative to that of a blob at the predicted position."""
        fit = math.log(max(spot.plausibility, 1e-6))
        if place is None:
            fit += _NEW
        else:
            fit += -0.5 * ((spot.u - place.u) ** 2 + (spot.v - place.v) ** 2) / place.sigma_px**2
            fit -= 2.0 * math.log(place.sigma_px / _STEP_PX)
        anchor = self._anchors.get(self._patch_of[name])
        if anchor is not None:
            reach_px = _REACH_M * self._scale_px_m
            beyond = math.hypot(spot.u - anchor.u, spot.v - anchor.v) - reach_px
            # Standard deviation of that distance, as a share of it: the patch's area gives the scale to 5
            # to 10 %.
            fit -= 0.5 * (max(beyond, 0.0) / (0.1 * reach_px)) ** 2
        return fit
