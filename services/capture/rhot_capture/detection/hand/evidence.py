"""What a hand tells of its markers: its reach, direction and scale in the image, and skin beside the paint.

Faint colours occur everywhere in a room, some with a few pixels of a paint's typical colour among them; in pictures
without a hand they would be false detections. They are therefore searched for only where a finger can be that is being
occluded or is reappearing: no further from any detected marker than the recent largest distance of the hand's markers.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Mapping, Sequence
from itertools import pairwise
from typing import Final

import cv2
import numpy as np

from rhot.anatomy.markers import PaintedMarker, unshared_paints
from rhot.arrays import ImageArray
from rhot.geometry.hull import Region
from rhot_capture.detection.candidates import MIN_PLAUSIBILITY, Candidate, Refusal, track_plausibility, without
from rhot_capture.detection.color_table import ColorTable, pack
from rhot_capture.detection.subpixel.batch import skin_ring
from rhot_capture.detection.track import MarkerTrack, find_regions

# Whether a blob adjoins skin, as painted fingertips do; rejects objects of a paint's colour apart from the hand.
#
# While a fingertip is hidden, a sleeve of its colour would be taken for it, and its track would then prefer the
# sleeve to the fingertip when that comes back. A blob without skin around it is therefore accepted only where the
# marker just was: a finger that points at the camera hides its own skin. The rule holds only while other fingertips
# of the hand adjoin skin, so that gloves and skin of an unusual colour do not matter.

_APART: Final = 0.02
"""Largest share around a blob apart from the hand: single pixels of a room have the colour of skin. Chosen."""
_LASTS_FRAMES: Final = 30
"""For so many frames it is known of a fingertip that it adjoined skin: half a second at 60 Hz. Chosen."""
_SKIN_CONTACT_FEWEST: Final = 2
"""Number of other fingertips that must adjoin skin. Chosen."""
_NEAR: Final = 0.5
"""Smallest agreement with the track of a blob that is where the marker just was; see `MarkerTrack.preference`."""


class SkinContact:
    """Contact of fingertips with skin in one camera.

    Args:
        markers: of the rig, by name; only fingertips are examined.
    """

    def __init__(self, markers: Mapping[str, PaintedMarker]) -> None:
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
            if adjoining[self._hand_of[name]] - is_known >= _SKIN_CONTACT_FEWEST:
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


# Direction of each hand in the image; rejects blobs behind the wrist, such as a cuff of a fingertip's colour.
#
# The patch on the back of the hand lies between wrist and fingertips. As long as three fingertips are seen, the hand
# points from its patch to them; then it turns with the sides of the patch, which are along and across the hand.

_AXIS_FEWEST: Final = 3
"""Number of fingertips required for the direction: two may be one and a cuff. Chosen."""
_BEHIND: Final = 1.0
"""No fingertip is further behind the middle of its patch than this many times the root of the patch's area, 3 cm: the
crease of the wrist is 2.5 cm behind it."""


class HandAxis:
    """Direction of each hand in one camera.

    Args:
        markers: of the rig, by name; paints of both hands, which do not identify the hand, are not used.
    """

    def __init__(self, markers: Mapping[str, PaintedMarker]) -> None:
        own = unshared_paints(markers)
        patches = {marker.hand: name for name, marker in markers.items() if name in own and marker.kind == "patch"}
        # Patch of each fingertip's hand.
        self._patch_of = {
            name: patches[marker.hand]
            for name, marker in markers.items()
            if name in own and marker.kind == "cap" and marker.hand in patches
        }
        # By patch; u, v and root of its area in the last frame.
        self._axis: dict[str, tuple[float, float]] = {}
        self._last: dict[str, tuple[float, float, float]] = {}

    def clear(self) -> None:
        """Discard the directions."""
        self._axis.clear()

    def update(
        self,
        centres: Mapping[str, tuple[float, float, float]],
        corners: Mapping[str, Sequence[tuple[float, float]]],
    ) -> None:
        """Update with a frame's detections.

        Args:
            centres: u, v and area of each detected marker, pixels and square pixels.
            corners: of detected patches, in order, pixels.
        """
        for patch in set(self._patch_of.values()):
            if patch not in centres:
                self._axis.pop(patch, None)
                continue
            u, v, area = centres[patch]
            self._last[patch] = u, v, math.sqrt(area)
            tips = [centres[name] for name, own in self._patch_of.items() if own == patch and name in centres]
            if len(tips) >= _AXIS_FEWEST:
                x = sum(tip[0] for tip in tips) / len(tips) - u
                y = sum(tip[1] for tip in tips) / len(tips) - v
                length = math.hypot(x, y)
                self._axis[patch] = (x / length, y / length) if length > 0.0 else (0.0, 0.0)
            elif patch in self._axis and patch in corners:
                self._axis[patch] = _nearest_side(self._axis[patch], corners[patch])

    def fitting(
        self, candidates: Mapping[str, list[Candidate]], judged: list[tuple[str, Candidate | Refusal]]
    ) -> Mapping[str, list[Candidate]]:
        """Return the candidates that are not behind the wrist.

        Args:
            candidates: by marker.
            judged: name and verdict of every blob; rejected candidates are replaced by refusals.
        """
        limits: dict[str, tuple[float, float, float]] = {}
        for patch, (x, y) in self._axis.items():
            u, v, size = self._last[patch]
            if patch in candidates:
                base = max(candidates[patch], key=lambda one: one.plausibility).blob
                (u, v), size = base.middle, math.sqrt(base.area)
            limits[patch] = x, y, x * u + y * v - _BEHIND * size
        behind: list[Candidate] = []
        for name, each in candidates.items():
            limit = limits.get(self._patch_of.get(name, ""))
            if limit is not None:
                x, y, least = limit
                for one in each:
                    u, v = one.blob.middle
                    if x * u + y * v < least:
                        behind.append(one)
        return without(behind, candidates, judged, "behind the wrist")


def _nearest_side(axis: tuple[float, float], corners: Sequence[tuple[float, float]]) -> tuple[float, float]:
    """Return the direction of a side of a patch, either way, that is nearest to the last axis."""
    best, most = axis, 0.0
    for (x0, y0), (x1, y1) in pairwise(corners):
        length = math.hypot(x1 - x0, y1 - y0)
        x, y = (x1 - x0) / max(length, 1e-9), (y1 - y0) / max(length, 1e-9)
        along = x * axis[0] + y * axis[1]
        if abs(along) > most:
            best, most = ((x, y) if along > 0.0 else (-x, -y)), abs(along)
    return best


# Scale of each hand in the image, estimated from its markers; rejects larger objects of a paint's colour.
#
# All markers of a hand are at a similar distance from the camera, so a square metre of paint covers about the same
# number of pixels. Paint that is seen obliquely or partly occluded covers fewer pixels, never more.

_MOST: Final = 4.0
"""Largest area of a marker, as a multiple of the area implied by its size and the hand's scale. A thumb's cap is 1.7
times that of a finger; a fingertip 10 cm nearer than the palm at 50 cm appears 1.6 times as large. Chosen."""
_SCALE_FEWEST: Final = 4
"""Number of visible markers required to estimate the scale: of a fist, only the patch and slivers are visible.
Chosen."""
_SCALE_MEMORY: Final = 0.999
"""Decay of the scale per frame with that many markers: half in 700 frames. It is slow so that a hand with partly
occluded tips keeps the scale of the open hand."""


class HandScale:
    """Scale of each hand in one camera, pixels per square metre of paint.

    Args:
        markers: of the rig, by name. Balls, whose size is unknown, and paints of both hands, which do not identify the
            hand, are not used.
    """

    def __init__(self, markers: Mapping[str, PaintedMarker]) -> None:
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
            self._scale[hand] = (
                max(_SCALE_MEMORY * kept, sorted(seen)[-2]) if len(seen) >= _SCALE_FEWEST else 1.005 * kept
            )


# Search regions of missing markers: within a hand's reach of the hand's other markers.

_FEWEST: Final = 3
"""Number of markers required to measure a hand's extent, if it has as many: fewer may all be false detections."""
_MEMORY: Final = 0.999
"""Decay of the extent per searched frame: half in 700 frames, 12 to 23 s. A grasping hand, of which little is visible,
keeps the extent of the open hand; after a hand has left, the extent adapts to the next one."""


class HandReach:
    """Extent of each hand's markers in one camera.

    Args:
        markers: of the rig, by name.
    """

    def __init__(self, markers: Mapping[str, PaintedMarker]) -> None:
        self._hand_of = {name: marker.hand for name, marker in markers.items()}
        self._alone = unshared_paints(markers)
        hands = list(self._hand_of.values())
        self._fewest = {hand: min(_FEWEST, hands.count(hand)) for hand in hands}
        self._extent_px = dict.fromkeys(hands, 0.0)
        self._table: tuple[ImageArray, tuple[int, ...]] | None = None
        self._labels_of: ImageArray = np.zeros(0, np.uint8)

    def clear(self) -> None:
        """Discard the extents."""
        self._extent_px = dict.fromkeys(self._extent_px, 0.0)

    def looks(
        self, image: ImageArray, table: ColorTable, missing: Mapping[str, int], found: Mapping[str, Candidate]
    ) -> list[tuple[int, Region]]:
        """Update the extents, and return label and region of faint colours that may be missing markers.

        Args:
            image: (H, W, 3) uint8 BGR.
            table: colours of the labels.
            missing: labels by marker that was not detected; paints that both hands have are not searched for.
            found: the detected markers; they update the extents.
        """
        looks = []
        for hand, kept_px in self._extent_px.items():
            middles = [each.blob.middle for name, each in found.items() if self._hand_of[name] == hand]
            extent_px = _MEMORY * kept_px
            u, v = [each[0] for each in middles], [each[1] for each in middles]
            if len(middles) >= self._fewest[hand]:
                extent_px = max(extent_px, max(u) - min(u), max(v) - min(v))
            self._extent_px[hand] = extent_px
            labels = tuple(
                sorted([missing[name] for name in self._alone & missing.keys() if self._hand_of[name] == hand])
            )
            if labels and middles and extent_px > 0.0:
                height, width = image.shape[:2]
                # Approximate half width of a marker: extents are measured between centres.
                room = extent_px + 12
                left, right = max(0, int(max(u) - room)), min(width, int(min(u) + room) + 1)
                top, bottom = max(0, int(max(v) - room)), min(height, int(min(v) + room) + 1)
                if right - left < 2 or bottom - top < 2:
                    # Farther apart than the hand is wide: not all of them are on it, and nothing is near to all.
                    continue
                part = image[top:bottom, left:right]
                for label, region in find_regions(part, self._faint(table, labels)):
                    x, y, across, down = region
                    looks.append((label, Region(x + left, y + top, across + left, down + top)))
        return looks

    def _faint(self, table: ColorTable, labels: tuple[int, ...]) -> ImageArray:
        """Return the table of faint colours of some labels, (65536,) uint8; cached for the last labels."""
        if self._table is None or self._table[0] is not table.faint or self._table[1] != labels:
            wanted = np.zeros(256, np.uint8)
            wanted[list(labels)] = labels
            self._table, self._labels_of = (table.faint, labels), wanted[table.faint]
        return self._labels_of
