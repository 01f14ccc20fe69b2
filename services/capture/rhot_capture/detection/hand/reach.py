"""Search regions of missing markers: within a hand's reach of the hand's other markers.

Faint colours occur everywhere in a room, some with a few pixels of a paint's typical colour among them; in pictures
without a hand they would be false detections. They are therefore searched for only where a finger can be that is being
occluded or is reappearing: no further from any detected marker than the recent largest distance of the hand's markers.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Final

import numpy as np

from rhot.arrays import ImageArray
from rhot.geometry.region import Region
from rhot.rig.config import MarkerConfig
from rhot.rig.marker_config import unshared_paints
from rhot_capture.detection.candidates import Candidate
from rhot_capture.detection.color_table import ColorTable
from rhot_capture.detection.search import find_regions

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

    def __init__(self, markers: Mapping[str, MarkerConfig]) -> None:
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
