"""What a foot's outlier gate refused, in case the filter was wrong and not the observations."""

from __future__ import annotations

import math
from typing import Final

import numpy as np

from rhot_feet.filter.model import Observation

_FASTEST_M_S: Final = 8.0
"""Feet are not faster: the swing of a sprinting foot."""
_LONGEST_GAP_S: Final = 0.3
"""Observations farther apart say nothing about each other; chosen."""
_SIGMAS: Final = 4.0
"""Of both observations' stated errors, beyond what a foot can move between them; chosen."""


class OutlierRun:
    """Refused observations in a row that agree with each other.

    Args:
        agreeing: so many in a row are right.
    """

    def __init__(self, agreeing: int) -> None:
        self._agreeing = agreeing
        self._row: list[Observation] = []

    def clear(self) -> None:
        """Forget them: an observation was accepted."""
        self._row.clear()

    def add(self, observation: Observation) -> bool:
        """Add a refused observation; return whether enough agree, which ends the row."""
        if self._row and not _agree(self._row[-1], observation):
            self._row.clear()
        self._row.append(observation)
        if len(self._row) < self._agreeing:
            return False
        self._row.clear()
        return True


def _agree(before: Observation, after: Observation) -> bool:
    """Return whether one foot may have been at both positions, one after the other."""
    span_s = (after.t_ns - before.t_ns) * 1e-9
    if not 0.0 < span_s < _LONGEST_GAP_S:
        return False
    reach_m = _FASTEST_M_S * span_s + _SIGMAS * math.sqrt(float(np.trace(before.covariance + after.covariance)))
    change = after.position - before.position
    return math.sqrt(float(change @ change)) <= reach_m
