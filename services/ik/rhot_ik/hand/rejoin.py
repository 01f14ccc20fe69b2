"""How a finger that comes back is led in: no joint jumps, and what was seen all along is not slowed down.

When a hidden finger is seen again, what was shown of it and what is known now differ by as much as the guess was wrong.
That difference is added to what is shown and run down at a bounded speed; the estimate itself knows nothing of it.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np

from rhot.arrays import BoolArray, FloatArray
from rhot_ik.hand.fingers.geometry import FingerGeometry


@dataclass(frozen=True, slots=True)
class RejoinSettings:
    """How fast a guess gives way to what is seen.

    Attributes:
        speed_m_s: a tip is led in at this speed: 30 mm, a usual error of a guess, in 25 ms; fingers themselves move at
            up to 1 to 2 m/s.
        step_m: and by no more than this from one sample to the next; the ruler's limit for a step is 10 mm.
    """

    speed_m_s: float = 1.2
    step_m: float = 0.009


class Rejoin:
    """Differences (5, 4), radians, to add to the angles of the fingers.

    Args:
        geometry: of the hand.
        settings: how fast they are run down.
    """

    def __init__(self, geometry: FingerGeometry, settings: RejoinSettings | None = None) -> None:
        self._geometry = geometry
        self._settings = settings or RejoinSettings()
        self._lead = np.zeros((5, 4))
        self._under_way = False

    def begin(self, which: BoolArray, now: FloatArray, shown: FloatArray) -> None:
        """Let the fingers `which` (5,) set out from what was shown (5, 4) for what is known now (5, 4)."""
        self._lead[which] = (shown - now)[which]
        self._under_way = True

    def advance(self, dt_s: float, angles: FloatArray) -> None:
        """Run the differences to the angles (5, 4) that are known now down."""
        if not self._under_way:
            return
        way = self._geometry.marker_points(angles + self._lead) - self._geometry.marker_points(angles)
        path_m = np.sqrt((way * way).sum(-1))
        step_m = min(self._settings.speed_m_s * dt_s, self._settings.step_m)
        self._lead *= np.maximum(0.0, 1.0 - step_m / np.maximum(path_m, _NONE_M))[:, None]
        self._under_way = bool(self._lead.any())

    def shown(self, angles: FloatArray) -> FloatArray:
        """Return the angles (5, 4) to show of those that are known (5, 4)."""
        return angles + self._lead if self._under_way else angles


_NONE_M: Final = 1e-9
