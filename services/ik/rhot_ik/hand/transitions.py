"""How the hand goes over to a new source without a jump, and what was seen all along is not slowed down.

When the source of a value changes (a hidden finger is seen again, the palm's patch appears), the difference between
what was published and what is known now becomes an offset. It is added to what is published and shrinks to nothing at a
bounded speed.
"""

from __future__ import annotations

from typing import Final

import numpy as np
from numpy.typing import NDArray

from rhot.anatomy.hand import HandModel
from rhot.arrays import FloatArray
from rhot.geometry.rotations import rotation_from_vector, vector_from_rotation

FINGER_M_S: Final = 0.15
"""A finger's offset shrinks by this much path of its tip a second. Chosen on simulated grasps."""
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
"""The offset of a palm that was far wrong shrinks faster, so that it is gone after this time."""


class FingerTransition:
    """Offsets (5, 4), radians, to add to the angles of the fingers."""

    def __init__(self, model: HandModel) -> None:
        reach = model.bones[:, ::-1].cumsum(axis=1)[:, ::-1]
        self._arms = reach[:, (0, 0, 1, 2)]
        self._offset = np.zeros((5, 4))
        self._under_way = False

    def begin(self, which: NDArray[np.bool_], now: FloatArray, shown: FloatArray) -> None:
        """Start a transition of the fingers `which` (5,) from the angles shown (5, 4) to those known now (5, 4)."""
        self._offset[which] = (shown - now)[which]
        self._under_way = True

    def advance(self, dt_s: float) -> None:
        """Shrink the offsets by the time that passed."""
        if not self._under_way:
            return
        path_m = (np.abs(self._offset) * self._arms).sum(axis=1)
        self._offset *= np.maximum(0.0, 1.0 - FINGER_M_S * dt_s / np.maximum(path_m, 1e-9))[:, None]
        self._under_way = bool(self._offset.any())

    def apply(self, angles: FloatArray) -> FloatArray:
        """Return the angles (5, 4) to publish."""
        return angles + self._offset if self._under_way else angles

    def limit_step(self, angles: FloatArray, shown: FloatArray, most_m: FloatArray) -> FloatArray:
        """Return angles (5, 4) that move no joint of a finger by more than `most_m` (5,), metres, from those shown."""
        change = angles - shown
        path_m = (np.abs(change) * self._arms).sum(axis=1)
        share = np.minimum(1.0, most_m / np.maximum(path_m, 1e-9))
        bounded: FloatArray = shown + share[:, None] * change
        return bounded


class FingerStepLimit:
    """How far each finger may move its joints from one sample to the next."""

    def __init__(self) -> None:
        self._speed_m_s = np.zeros(5)
        self._distrust_s = np.zeros(5)

    def advance(self, dt_s: float, way_m: FloatArray, measured: NDArray[np.bool_]) -> FloatArray:
        """Return the largest step (5,), metres, of a sample `dt_s` after the last one.

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
        limit: FloatArray = np.where(measured, SEEN_M_S + PATH_PER_TIP * trust * self._speed_m_s, HIDDEN_M_S) * dt_s
        return limit


class PalmTransition:
    """A small rotation and translation to add to the pose of the wrist."""

    def __init__(self) -> None:
        self._rotation = np.zeros(3)
        self._translation = np.zeros(3)
        self._rotation_rad_s = PALM_RAD_S
        self._translation_m_s = PALM_M_S
        self._under_way = False

    def begin(self, expected: tuple[FloatArray, FloatArray], now: tuple[FloatArray, FloatArray]) -> None:
        """Start from the expected pose, its own offset included, towards the one known now; each (3, 3) and (3,)."""
        R, p = self.apply(*expected)
        self._rotation = vector_from_rotation(now[0].T @ R)
        self._translation = p - now[1]
        self._rotation_rad_s = max(PALM_RAD_S, _length(self._rotation) / PALM_LONGEST_S)
        self._translation_m_s = max(PALM_M_S, _length(self._translation) / PALM_LONGEST_S)
        self._under_way = True

    def advance(self, dt_s: float) -> None:
        """Shrink the offset by the time that passed."""
        if not self._under_way:
            return
        self._rotation *= max(0.0, 1.0 - self._rotation_rad_s * dt_s / _length(self._rotation))
        self._translation *= max(0.0, 1.0 - self._translation_m_s * dt_s / _length(self._translation))
        self._under_way = bool(self._rotation.any() or self._translation.any())

    def apply(self, R: FloatArray, p: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return the pose to publish of a wrist at R (3, 3), p (3,)."""
        if not self._under_way:
            return R, p
        return R @ rotation_from_vector(self._rotation), p + self._translation


def _length(vector: FloatArray) -> float:
    """Return the length of a vector (3,), never quite 0."""
    return max(float(np.sqrt(vector @ vector)), 1e-9)
