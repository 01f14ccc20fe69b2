"""What a foot's gate turned away, in case the filter was wrong and not the observations."""

from __future__ import annotations

import math
from typing import Final

import numpy as np

from rhot_feet.filter.model import Observation

_FASTEST: Final = 8.0
"""m/s; feet are not faster."""


class Rejected:
    """Observations that were turned away one after the other and agree with each other."""

    def __init__(self, agreeing: int) -> None:
        """Begin with none.

        Args:
            agreeing: so many in a row are right.
        """
        self._agreeing = agreeing
        self._row: list[Observation] = []

    def clear(self) -> None:
        """Forget them: an observation was believed."""
        self._row.clear()

    def add(self, observation: Observation) -> bool:
        """Take one more; tell whether enough agree, which ends the row."""
        if self._row and not _agree(self._row[-1], observation):
            self._row.clear()
        self._row.append(observation)
        if len(self._row) < self._agreeing:
            return False
        self._row.clear()
        return True


def _agree(before: Observation, after: Observation) -> bool:
    """Whether one foot may have been at both places, one after the other."""
    span_s = (after.t_ns - before.t_ns) * 1e-9
    if not 0.0 < span_s < 0.3:
        return False
    room = _FASTEST * span_s + 4.0 * math.sqrt(float(np.trace(before.covariance + after.covariance)))
    change = after.position - before.position
    return math.sqrt(float(change @ change)) <= room
