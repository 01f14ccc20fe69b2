"""Two hands, one paint: which blob of a shared colour is which hand's marker.

A blob belongs to a marker the more it lies where that marker is expected: where its motion carries it while it is
seen in every frame, and beside the patch of its hand as it was when it was seen last after that. It cannot lie further
from that patch than a hand reaches. Blobs and markers are matched all at once; a match that another one rivals is not
made: "not seen" is true, the other hand's name would not be.

All of it happens in one camera's picture, pixels; the patches tell the hands apart, as each wears a paint of its own.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Mapping, Sequence
from typing import Final, NamedTuple

from rhot.rig.config import MarkerConfig
from rhot_capture.detection.candidates import Candidate

_REACH_M: Final = 0.20
"""From the middle of a patch to a fingertip: 0.165 m for an average hand (189 mm from the wrist), whose middle finger
is longest; hands reach up to 0.22 m (hand.length_m allows 0.26), and a patch that is tilted looks smaller."""
_REACH_DEVIATION: Final = 0.1
"""Standard deviation of that reach, as a share of it: the patch's area gives the scale to 5 to 10 %."""
_STEP_PX: Final = 4.0
"""How far a fingertip is from where its motion carries it, standard deviation: 20 m/s² (the recordings' hardest
motion) for 1/30 s are 11 mm, 7 pixels of a camera with 0.6 pixels to the millimetre (640 columns, 62°, 0.85 m)."""
_DRIFT_PX: Final = 3.0
"""By how much more it is for every frame that the marker was not seen: fingers move against the hand."""
_MOST_DRIFT_PX: Final = 45.0
"""Half of a finger's way from open to closed in such a picture."""
_SURE_PX: Final = 10.0
"""A place that is known better than this is a fingertip's own width."""
_NEW: Final = math.log(0.02)
"""A marker of which nothing is known, beside one that is where it is expected."""
_MISSING: Final = math.log(1e-5)
"""A marker that is not seen, beside one that is where it is expected: what is 4.8 σ off is somewhere else."""
_PATCH_FRAMES: Final = 10
"""So many frames a patch that is not seen counts where it was: as long as a track is remembered."""
_CLEAR: Final = math.log(100.0)
"""A match is made when it is this much likelier than any other that names a blob otherwise: a wrong one would go on."""
_SCALE_MEMORY: Final = 0.995
"""What remains in a frame of the largest scale seen: hands rise and sink, at 1 m/s by 2 % in a frame of 1/60 s at most,
and half of a scale is forgotten in two seconds; until then a patch that is partly covered makes no hand small."""


class Anchor(NamedTuple):
    """A patch in the picture.

    Attributes:
        u, v: its middle, pixels.
        px_m: pixels to the metre on the hand.
    """

    u: float
    v: float
    px_m: float


class Spot(NamedTuple):
    """A blob, as far as it matters here.

    Attributes:
        u, v: its middle, pixels.
        across, down: its extent, pixels.
        area: square pixels.
        plausibility: 0 to 1, how much it is like its paint.
    """

    u: float
    v: float
    across: float
    down: float
    area: float
    plausibility: float

    def holds(self, place: Place) -> bool:
        """Tell whether a place lies within its bounds."""
        return 2.0 * abs(place.u - self.u) <= self.across and 2.0 * abs(place.v - self.v) <= self.down


def spot_of(candidate: Candidate) -> Spot:
    """Return what matters of a candidate."""
    u, v = candidate.blob.middle
    _, _, across, down = candidate.blob.box
    return Spot(u, v, across, down, candidate.blob.area, candidate.plausibility)


def anchor_of(spot: Spot, marker: MarkerConfig) -> Anchor:
    """Return what a patch says of its hand."""
    across_m, along_m = marker.size_m or (1.0, 1.0)
    return Anchor(spot.u, spot.v, math.sqrt(spot.area / (across_m * along_m)))


class Place(NamedTuple):
    """Where a marker is expected.

    Attributes:
        u, v: pixels.
        sigma_px: standard deviation.
    """

    u: float
    v: float
    sigma_px: float


class _Memory:
    """Where a marker was against its hand's patch when it was seen last."""

    __slots__ = ("beside", "missed")

    def __init__(self) -> None:
        self.beside: tuple[float, float] | None = None
        self.missed = 0


class SharedPaints:
    """Names the blobs of shared paints, frame after frame.

    Args:
        markers: of the rig, by name.
    """

    def __init__(self, markers: Mapping[str, MarkerConfig]) -> None:
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
        """Forget where the markers were."""
        self._memory = {name: _Memory() for name in self._memory}
        self._anchors, self._remembered = {}, {}
        self._kept_px_m = 0.0

    def see_patches(self, found: Mapping[str, Spot]) -> None:
        """Take the patches that were found in a frame; one that is not seen is believed where it was."""
        seen = {name: anchor_of(found[name], patch) for name, patch in self.patches.items() if name in found}
        self._anchors = self._remembered | seen
        # Hands are about as far away as each other, and a patch that is tilted or partly covered looks too small.
        self._scale_px_m = max([self._kept_px_m, *(anchor.px_m for anchor in seen.values())])

    def expected(self, name: str, carried: tuple[float, float] | None) -> Place | None:
        """Return where a marker is expected; None when nothing is known of it.

        Args:
            name: of the marker.
            carried: where its motion carries it from the last frame; None when it was not seen in that.
        """
        if carried is not None:
            return Place(*carried, _STEP_PX)
        memory, anchor = self._memory[name], self._anchors.get(self._patch_of[name])
        if anchor is None or memory.beside is None:
            return None
        sigma_px = min(_STEP_PX + _DRIFT_PX * memory.missed, _MOST_DRIFT_PX)
        return Place(anchor.u + memory.beside[0], anchor.v + memory.beside[1], sigma_px)

    def match(
        self, paint: str, spots: Sequence[Spot], carried: Mapping[str, tuple[float, float] | None]
    ) -> dict[str, int]:
        """Return by marker the number of its blob, of a paint that two wear; what is not clear is left out.

        Args:
            paint: the marker that stands for it.
            spots: its blobs.
            carried: of both markers, see `expected`.
        """
        first, second = self.wearers[paint]
        places = {name: self.expected(name, carried[name]) for name in (first, second)}
        here = [place for place in places.values() if place is not None and place.sigma_px <= _SURE_PX]
        # The paint of fingertips that touch is one blob: it is neither of them.
        apart = [k for k, spot in enumerate(spots) if len(here) < 2 or not all(spot.holds(place) for place in here)]
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
        """Take where the markers of a frame were, u and v in pixels; patches are among them."""
        self._kept_px_m = _SCALE_MEMORY * self._scale_px_m
        for patch in self.patches:
            self._unseen[patch] = 0 if patch in seen else self._unseen.get(patch, 0) + 1
        self._remembered = {
            patch: anchor for patch, anchor in self._anchors.items() if self._unseen[patch] <= _PATCH_FRAMES
        }
        for name, memory in self._memory.items():
            where, anchor = seen.get(name), self._anchors.get(self._patch_of[name])
            if where is None:
                memory.missed += 1
            elif anchor is not None:
                memory.beside, memory.missed = (where[0] - anchor.u, where[1] - anchor.v), 0

    def _fit(self, name: str, place: Place | None, spot: Spot) -> float:
        """Return how well a blob is a marker, logarithm of a likelihood beside that of one where it is expected."""
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
            fit -= 0.5 * (max(beyond, 0.0) / (_REACH_DEVIATION * reach_px)) ** 2
        return fit
