"""Where a marker that was not found may be: within a hand's reach of the other markers of its hand.

Faint colours occur everywhere in a room, and pixels of a paint's typical colour among them now and then: in pictures
without any hand they would be called markers. So they are looked for only where a finger can be that goes behind
another one or comes back: no further from any marker that was found than markers of this hand have lately been apart.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Final

import numpy as np

from rhot.arrays import ImageArray
from rhot.rig.config import MarkerConfig
from rhot.rig.marker_config import unshared_paints
from rhot_capture.detection.candidates import Candidate
from rhot_capture.detection.color_table import ColorTable
from rhot_capture.detection.cutouts import Region
from rhot_capture.detection.search import find_regions

_FEWEST: Final = 3
"""Markers that tell how large a hand is, if it has as many: fewer may all be something else."""
_MEMORY: Final = 0.999
"""What remains of the largest extent in a searched frame: half of it is forgotten in 700 such frames, 12 to 23 s. A
hand in a grasp, of which little is seen, remains as large as it was open; one that has gone makes room for another."""

_HALF_WIDTH_PX: Final = 12
"""Of a marker, about: reaches are measured from middle to middle."""


class HandReach:
    """How far markers of each hand are apart in one camera's picture, frame after frame.

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
        """Forget how far they are apart."""
        self._extent_px = dict.fromkeys(self._extent_px, 0.0)

    def looks(
        self, image: ImageArray, table: ColorTable, missing: Mapping[str, int], found: Mapping[str, Candidate]
    ) -> list[tuple[int, Region]]:
        """Return label and bounds of the regions that may hold missing markers in faint colours.

        Args:
            image: (H, W, 3) uint8 BGR.
            table: colours of the labels.
            missing: label of each marker that was not found; faint paint that two hands wear tells nothing.
            found: the others; how far they are apart is learnt.
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
                room = extent_px + _HALF_WIDTH_PX
                left, right = max(0, int(max(u) - room)), min(width, int(min(u) + room) + 1)
                top, bottom = max(0, int(max(v) - room)), min(height, int(min(v) + room) + 1)
                part = image[top:bottom, left:right]
                for label, region in find_regions(part, self._faint(table, labels)):
                    x, y, across, down = region
                    looks.append((label, Region(x + left, y + top, across + left, down + top)))
        return looks

    def _faint(self, table: ColorTable, labels: tuple[int, ...]) -> ImageArray:
        """Return the table of faint colours of some labels, (65536,) uint8; kept while they stay the same."""
        if self._table is None or self._table[0] is not table.faint or self._table[1] != labels:
            wanted = np.zeros(256, np.uint8)
            wanted[list(labels)] = labels
            self._table, self._labels_of = (table.faint, labels), wanted[table.faint]
        return self._labels_of
