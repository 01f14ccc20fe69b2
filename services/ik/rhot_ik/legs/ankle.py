"""An ankle, and how far it can be trusted."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class Ankle:
    """An ankle at a moment.

    Attributes:
        T_rig_ankle: (4, 4), axes level when the foot stands flat.
        trust: 1 = as measured, 0 = only guessed.
    """

    T_rig_ankle: FloatArray
    trust: float = 1.0

    @property
    def place(self) -> FloatArray:
        """(3,) metres, rig frame."""
        place: FloatArray = self.T_rig_ankle[:3, 3]
        return place
