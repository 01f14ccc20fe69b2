"""Gate points by their distance from the other markers of the same hand."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from rhot.arrays import BoolArray, FloatArray, IndexArray
from rhot.rig import MarkerConfig

_REACH = 1.2
"""Largest distance of a marker from the median of its hand's markers, in hand lengths: an open hand plus noise."""
_FEWEST = 3
"""Tracked markers required: of two, it is unknown which one is wrong."""


class HandCoherence:
    """Gates a marker's point by the median of the markers of its hand.

    Attributes:
        siblings: per marker, the indices of the others of its hand.
        company: (M, M) the same as a matrix: 1 = same hand, 0 = other hand or the marker itself.
    """

    def __init__(self, markers: Mapping[str, MarkerConfig], hand_length_m: float) -> None:
        sides = np.array([marker.hand for marker in markers.values()])
        self._hands: list[IndexArray] = [np.flatnonzero(sides == side) for side in np.unique(sides)]
        self._hand_of: IndexArray = np.searchsorted(np.unique(sides), sides)
        self.siblings: list[IndexArray] = [
            np.flatnonzero((sides == side) & (np.arange(len(sides)) != index)) for index, side in enumerate(sides)
        ]
        self.company: FloatArray = (sides[:, None] == sides[None]) * (1.0 - np.eye(len(sides)))
        self._reach_m = _REACH * hand_length_m

    def near(self, index: IndexArray, position: FloatArray, known: FloatArray, tracked: BoolArray) -> BoolArray:
        """Return which points (K, 3) of markers (K,) are near the median of their hand's known positions (M, 3).

        All pass where fewer than three markers (M,) of a hand are tracked. Metres, rig frame.
        """
        middles = np.full((len(self._hands), 3), np.nan)
        for hand, members in enumerate(self._hands):
            present = members[tracked[members]]
            if len(present) >= _FEWEST:
                # The lower median, because np.median would cost more than the rest of this function.
                middles[hand] = np.sort(known[present], axis=0)[(len(present) - 1) // 2]
        away = position - middles[self._hand_of[index]]
        far: BoolArray = (away * away).sum(axis=1) > self._reach_m**2
        return ~far
