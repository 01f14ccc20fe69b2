"""Direction of each hand in the image; rejects blobs behind the wrist, such as a cuff of a fingertip's colour.

The patch on the back of the hand lies between wrist and fingertips. As long as three fingertips are seen, the hand
points from its patch to them; then it turns with the sides of the patch, which are along and across the hand.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from itertools import pairwise
from typing import Final

from rhot.rig.config import MarkerConfig
from rhot.rig.marker_config import unshared_paints
from rhot_capture.detection.candidates import Candidate, Refusal, without

_FEWEST: Final = 3
"""Number of fingertips required for the direction: two may be one and a cuff. Chosen."""
_BEHIND: Final = 1.0
"""No fingertip is further behind the middle of its patch than this many times the root of the patch's area, 3 cm: the
crease of the wrist is 2.5 cm behind it."""


class HandAxis:
    """Direction of each hand in one camera.

    Args:
        markers: of the rig, by name; paints of both hands, which do not identify the hand, are not used.
    """

    def __init__(self, markers: Mapping[str, MarkerConfig]) -> None:
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
            if len(tips) >= _FEWEST:
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
