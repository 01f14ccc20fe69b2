"""Follow changes of the light's colour: sun and lamps turn all paints alike.

Light of another colour multiplies red, green and blue of all paints by the same factors (von Kries 1902). The median
over the paints of how much red and blue have grown against green, since they were calibrated, is what the light did;
what a single one does, such as paint beside a red sleeve, is not.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace
from typing import Final

import cv2
import numpy as np

from rhot.arrays import FloatArray, ImageArray
from rhot_capture.detection.color_table import ColorTable, in_balance, packed_of, table_colors

LOOK_FRAMES: Final = 6
"""Every so many frames the paints are looked at."""
_LOOKS: Final = 4
"""So many looks make a decision: 0.4 s at 60 Hz."""
_LEAST_PAINTS: Final = 3
"""That agree, and at least half of those seen; fewer may all be in the reflection of one thing."""
_AGREE: Final = 0.08
"""Farthest from the paints' median, logarithm of the factor. On rendered pictures, with and without a change of 20 %,
half of the paints are within 0.03 of it."""
_LEAST: Final = 0.04
"""Smaller changes are within the calibrated classes; the median is true to 0.02."""
_MOST: Final = 0.6
"""Largest change: a factor of 1.8 between red or blue and green. From an overcast sky to an incandescent lamp it is
about 2.5."""
_BLIND: Final = 8
"""So many decisions in a row with hardly a paint, and another light is tried."""
_DARK: Final = 20.0
_BRIGHT: Final = 245.0
"""Grey levels between which a channel is used: below, the camera's black level counts."""
_CORE: Final = np.ones((3, 3), np.uint8)


class Light:
    """The colour of the light, relative to that of the calibration.

    Attributes:
        shift: (2,) by how much ln(R/G) and ln(B/G) of all paints have grown.
    """

    def __init__(self) -> None:
        self.shift: FloatArray = np.zeros(2)
        self._seen = self.shift
        self._frames = self._blind = self._looks = 0
        # Of each label: sums of red, green and blue, and their number.
        self._sums: dict[int, list[float]] = {}

    def is_due(self) -> bool:
        """Count a frame; return whether its paints are to be looked at."""
        self._frames = (self._frames + 1) % LOOK_FRAMES
        return self._frames == 0

    def look(self, table: ColorTable, blobs: Iterable[tuple[int, ImageArray, ImageArray]]) -> bool:
        """Take the paints of a frame; return whether the light has changed.

        Args:
            table: of the calibration.
            blobs: of each marker its label, pixels (h, w, 3) uint8 BGR and mask (h, w) uint8.
        """
        for label, pixels, mask in blobs:
            # Pixels at the rim are mixed with what is beside them.
            core = cv2.erode(mask, _CORE, borderType=cv2.BORDER_CONSTANT, borderValue=0)
            blue, green, red, _ = cv2.mean(pixels, core)
            if green:
                sums = self._sums.setdefault(label, [0.0, 0.0, 0.0, 0.0])
                for place, value in enumerate((red, green, blue, 1.0)):
                    sums[place] += value
        self._looks += 1
        if self._looks < _LOOKS:
            return False
        looked, self._sums, self._looks = self._sums, {}, 0
        return self._decide(table, looked)

    def _decide(self, table: ColorTable, sums: dict[int, list[float]]) -> bool:
        if len(sums) < 2:
            return self._try_another()
        self._blind = 0
        seen = np.array(list(sums.values()))
        seen = seen[:, :3] / seen[:, 3:]
        there = table.middles[np.array(list(sums)) - 1]
        # What is nearly black or saturated in one light says nothing of another.
        known = (np.minimum(seen, there) > _DARK) & (np.maximum(seen, there) < _BRIGHT)
        shift = self.shift.copy()
        for axis, channel in enumerate((0, 2)):
            use = known[:, channel] & known[:, 1]
            moved = np.log(seen[use, channel] * there[use, 1] / (there[use, channel] * seen[use, 1]))
            agree = np.abs(moved - np.median(moved)) < _AGREE if use.any() else use
            if agree.sum() >= max(_LEAST_PAINTS, 0.5 * len(moved)):
                shift[axis] = moved[agree].mean()
        if (np.abs(shift - self.shift) < _LEAST).all():
            return False
        self.shift = self._seen = np.clip(shift, -_MOST, _MOST)
        return True

    def _try_another(self) -> bool:
        """Go back to the light of the calibration, and from there to the last one, while there is hardly a paint.

        No hand is in view, or the light was switched.
        """
        self._blind += 1
        if self._blind % _BLIND or not self._seen.any():
            return False
        self.shift = np.zeros(2) if self.shift.any() else self._seen
        return True

    def on(self, table: ColorTable) -> ColorTable:
        """Return a table of the calibration for pictures in this light."""
        if not self.shift.any():
            return table
        red, blue = np.exp(-self.shift).tolist()
        there = packed_of(in_balance(table_colors(), (red, 1.0, blue)))
        return replace(
            table,
            labels=table.labels[there],
            likelihoods=table.likelihoods[there],
            faint=table.faint[there],
            skin=None if table.skin is None else table.skin[there],
        )
