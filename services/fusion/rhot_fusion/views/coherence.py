"""Markers on one hand lie within a hand's length of each other, whatever the hand does."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from rhot.arrays import BoolArray, FloatArray, IndexArray
from rhot.rig import MarkerConfig

_REACH = 1.2
"""Furthest marker from the middle of its hand's markers, in hand lengths: an open hand, with room for noise."""
_FEWEST = 3
"""Of two markers nobody knows which one is out of reach."""


class HandCoherence:
    """Gates a marker's point by the median of the markers of its hand.

    Attributes:
        siblings: per marker the indices of the others of its hand.
        company: (M, M) the same as a matrix of ones.
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
        """Tell which points (K, 3) of markers (K,) are within reach of their hand's known positions (M, 3).

        Where fewer than three markers of a hand are tracked nothing is refused.
        """
        middles = np.full((len(self._hands), 3), np.nan)
        for hand, members in enumerate(self._hands):
            present = members[tracked[members]]
            if len(present) >= _FEWEST:
                # The lower median: np.median costs more than all the rest of this gate.
                middles[hand] = np.sort(known[present], axis=0)[(len(present) - 1) // 2]
        away = position - middles[self._hand_of[index]]
        far: BoolArray = (away * away).sum(axis=1) > self._reach_m**2
        return ~far
