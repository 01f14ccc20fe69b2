"""How what comes back is led in: no joint jumps, and what was seen all along is not slowed down.

When the source of a value changes (a hidden finger is seen again, the palm's patch appears), the difference between
what was shown and what is known now is kept as a lead that is added to what is shown and run down at a bounded speed.
"""

from __future__ import annotations

from typing import Final

import numpy as np
from numpy.typing import NDArray

from rhot.anatomy.hand import HandModel
from rhot.geometry.rotations import rotation_from_vector, vector_from_rotation

FloatArray = NDArray[np.float64]

FINGER_M_S: Final = 0.15
"""A fingertip is led in at this speed relative to the palm."""
HIDDEN_M_S: Final = 0.15
"""A hidden finger moves no faster relative to the palm: with its neighbours, but not with their every twitch."""
SEEN_M_S: Final = 0.20
PATH_PER_TIP: Final = 1.5
"""A seen finger moves its joints no faster than this many times its marker, and that speed on top."""
MARKER_M_S2: Final = 20.0
"""A marker that gains speed faster than this jumps: the finger follows as far as this allows."""
DISTRUST_S: Final = 0.12
"""A marker that returns is followed fully after as long as it was hidden, at most this: the first points err most."""
PALM_M_S: Final = 0.12
PALM_RAD_S: Final = 0.8
PALM_LONGEST_S: Final = 0.5
"""A palm that was far wrong is led in faster, so that it is right after this time."""


class FingerLead:
    """Leads (5, 4), radians, to add to the angles of the fingers."""

    def __init__(self, model: HandModel) -> None:
        reach = model.bones[:, ::-1].cumsum(axis=1)[:, ::-1]
        self._arms = reach[:, (0, 0, 1, 2)]
        self._lead = np.zeros((5, 4))
        self._under_way = False

    def begin(self, which: NDArray[np.bool_], now: FloatArray, shown: FloatArray) -> None:
        """Let the fingers `which` (5,) set out from what was shown (5, 4) for what is known now (5, 4)."""
        self._lead[which] = (shown - now)[which]
        self._under_way = True

    def advance(self, dt_s: float) -> None:
        """Run the leads down."""
        if not self._under_way:
            return
        path_m = (np.abs(self._lead) * self._arms).sum(axis=1)
        self._lead *= np.maximum(0.0, 1.0 - FINGER_M_S * dt_s / np.maximum(path_m, 1e-9))[:, None]
        self._under_way = bool(self._lead.any())

    def lead(self, angles: FloatArray) -> FloatArray:
        """Return the angles (5, 4) to show."""
        return angles + self._lead if self._under_way else angles

    def bounded(self, angles: FloatArray, shown: FloatArray, most_m: FloatArray) -> FloatArray:
        """Return angles (5, 4) that move no joint of a finger by more than `most_m` (5,), metres, from those shown."""
        change = angles - shown
        path_m = (np.abs(change) * self._arms).sum(axis=1)
        share = np.minimum(1.0, most_m / np.maximum(path_m, 1e-9))
        bounded: FloatArray = shown + share[:, None] * change
        return bounded


class FingerRoom:
    """How far each finger may move its joints from one sample to the next."""

    def __init__(self) -> None:
        self._speed_m_s = np.zeros(5)
        self._distrust_s = np.zeros(5)

    def advance(self, dt_s: float, way_m: FloatArray, measured: NDArray[np.bool_]) -> FloatArray:
        """Return the room (5,), metres, of a sample `dt_s` after the last one.

        Args:
            dt_s: seconds.
            way_m: (5,) metres that each marker moved; NaN where it was not seen twice.
            measured: (5,) whether it was measured.
        """
        if dt_s <= 0.0:
            return np.zeros(5)
        speed = np.where(way_m >= 0.0, way_m, 0.0) / dt_s
        self._speed_m_s = np.minimum(speed, self._speed_m_s + MARKER_M_S2 * dt_s)
        self._distrust_s = np.where(
            measured, np.maximum(self._distrust_s - dt_s, 0.0), np.minimum(self._distrust_s + dt_s, DISTRUST_S)
        )
        trust = (1.0 - self._distrust_s / DISTRUST_S) ** 2
        room: FloatArray = np.where(measured, SEEN_M_S + PATH_PER_TIP * trust * self._speed_m_s, HIDDEN_M_S) * dt_s
        return room


class PalmLead:
    """A small turn and way to add to the pose of the wrist."""

    def __init__(self) -> None:
        self._turn = np.zeros(3)
        self._way = np.zeros(3)
        self._turn_rad_s = PALM_RAD_S
        self._way_m_s = PALM_M_S
        self._under_way = False

    def begin(self, expected: tuple[FloatArray, FloatArray], now: tuple[FloatArray, FloatArray]) -> None:
        """Set out from the expected pose, itself led, for the pose that is known now; each (3, 3) and (3,)."""
        R, p = self.lead(*expected)
        self._turn = vector_from_rotation(now[0].T @ R)
        self._way = p - now[1]
        self._turn_rad_s = max(PALM_RAD_S, float(np.sqrt(self._turn @ self._turn)) / PALM_LONGEST_S)
        self._way_m_s = max(PALM_M_S, float(np.sqrt(self._way @ self._way)) / PALM_LONGEST_S)
        self._under_way = True

    def advance(self, dt_s: float) -> None:
        """Run the lead down."""
        if not self._under_way:
            return
        self._turn *= max(0.0, 1.0 - self._turn_rad_s * dt_s / max(float(np.sqrt(self._turn @ self._turn)), 1e-9))
        self._way *= max(0.0, 1.0 - self._way_m_s * dt_s / max(float(np.sqrt(self._way @ self._way)), 1e-9))
        self._under_way = bool(self._turn.any() or self._way.any())

    def lead(self, R: FloatArray, p: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return the pose to show of a wrist at R (3, 3), p (3,)."""
        if not self._under_way:
            return R, p
        return R @ rotation_from_vector(self._turn), p + self._way
