"""Follow changes of the light's colour: sun and lamps turn all paints alike.

Light of another colour multiplies red, green and blue of all paints by the same factors (von Kries 1902). The median
over the paints of how much red and blue have grown against green, since they were calibrated, is what the light did;
what a single one does, such as paint beside a red sleeve, is not. After a larger step paints are taken for each other,
or for nothing: where few are what their labels say, a frame is searched in other lights, and the one in which most
agree is it.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import replace
from typing import Final, TypeAlias

import cv2
import numpy as np

from rhot.arrays import FloatArray, ImageArray
from rhot_capture.detection.color_table import ColorTable, in_balance, packed_of, table_colors

Paint: TypeAlias = tuple[int, ImageArray, ImageArray]
"""A marker's label, pixels (h, w, 3) uint8 BGR and mask (h, w) uint8."""

_LOOK_FRAMES: Final = 6
"""Every so many frames the paints are looked at; every frame until the light is known."""
_LOOKS: Final = 4
"""So many looks make a decision: 0.4 s at 60 Hz, 0.07 s until the light is known."""
_LEAST_PAINTS: Final = 3
"""That agree, and at least half of those seen; fewer may all be in the reflection of one thing."""
_AGREE: Final = 0.08
"""Farthest from the paints' median, logarithm of the factor. On rendered pictures, with and without a change of 20 %,
half of the paints are within 0.03 of it."""
_EXPLAINED: Final = 0.15
"""Farthest from the light in use for a paint to be what its label says. Paint that is cut off at white is 0.1 off."""
_LEAST: Final = 0.07
"""Smaller changes are within the calibrated classes, and paint that is nearly cut off says as much by itself."""
_MOST: Final = 0.6
"""Largest change: a factor of 1.8 between red or blue and green. From an overcast sky to an incandescent lamp it is
about 2.5."""
_TINT: Final = 0.25
"""Largest change towards magenta or green. Day and incandescent lamps lie on the line where red grows as blue shrinks
(Finlayson et al. 1994); what is far from it are paints that are taken for others."""
_STEP: Final = 0.25
_TRIED: Final = tuple(_STEP * np.array([n, -n]) for n in (0, 1, -1, 2, -2))
"""Lights to try, on that line. Paints are found in one that is half a step off."""
_PATIENCE: Final = 1, 8
"""Decisions in doubt until other lights are tried: at first, and at most, each time doubled. It takes the time of some
frames."""
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
        self._is_known = False
        self._frames = self._looks = 0
        # Of each label: sums of red, green and blue, and their number.
        self._sums: dict[int, list[float]] = {}
        self._patience = self._wait = _PATIENCE[0]

    def is_due(self) -> bool:
        """Count a frame; return whether its paints are to be looked at."""
        self._frames = (self._frames + 1) % _LOOK_FRAMES
        return self._frames == 0 or not self._is_known

    def look(self, table: ColorTable, paints: Iterable[Paint], search: Callable[[ColorTable], Iterable[Paint]]) -> bool:
        """Take the paints of a frame; return whether another light is to be used.

        Args:
            table: of the calibration.
            paints: found in the light in use.
            search: finds those of the same frame by another table.
        """
        _add(self._sums, paints)
        self._looks += 1
        if self._looks < _LOOKS:
            return False
        looked, self._sums, self._looks = self._sums, {}, 0
        before = self.shift
        explained = self._follow(_moved(table, looked))
        if explained < _LEAST_PAINTS <= len(table.names) and self._has_waited():
            self._try_others(table, explained, search)
        return self.shift is not before

    def _follow(self, moved: FloatArray) -> int:
        """Follow what most paints say, and return how many are explained: all that are needed where none is strange."""
        shift = _said(moved, self.shift)
        has_changed = bool((np.abs(shift - self.shift) > _LEAST).any())
        if has_changed:
            self.shift = shift
        explained = _near(moved, self.shift, _EXPLAINED)
        # Few markers are no reason to doubt: the hand may be half out of view, or its paint half hidden.
        seen = int((~np.isnan(moved).all(axis=1)).sum())
        if explained >= _LEAST_PAINTS or 0 < explained == seen:
            self._is_known = not has_changed and (self._is_known or explained >= _LEAST_PAINTS)
            self._patience = self._wait = max(self._patience - 1, _PATIENCE[0])
            return _LEAST_PAINTS
        self._is_known = False
        return explained

    def _has_waited(self) -> bool:
        self._wait -= 1
        if self._wait:
            return False
        self._patience = self._wait = min(2 * self._patience, _PATIENCE[1])
        return True

    def _try_others(self, table: ColorTable, explained: int, search: Callable[[ColorTable], Iterable[Paint]]) -> None:
        """Take the light in which most paints agree, more than are explained by the one in use."""

        def found_in(shift: FloatArray) -> tuple[int, FloatArray]:
            sums: dict[int, list[float]] = {}
            _add(sums, search(_in_light(table, shift)))
            moved = _moved(table, sums)
            said = _said(moved, shift)
            return _near(moved, said, _AGREE), said

        others = [tried for tried in _TRIED if (np.abs(tried - self.shift) > 0.5 * _STEP).any()]
        agree, said = max(map(found_in, others), key=lambda found: found[0])
        if agree > max(explained, _LEAST_PAINTS - 1):
            self.shift = said

    def on(self, table: ColorTable) -> ColorTable:
        """Return a table of the calibration for pictures in this light."""
        return _in_light(table, self.shift)


def _in_light(table: ColorTable, shift: FloatArray) -> ColorTable:
    if not shift.any():
        return table
    red, blue = np.exp(-shift).tolist()
    there = packed_of(in_balance(table_colors(), (red, 1.0, blue)))
    return replace(
        table,
        labels=table.labels[there],
        likelihoods=table.likelihoods[there],
        faint=table.faint[there],
        skin=None if table.skin is None else table.skin[there],
    )


def _add(sums: dict[int, list[float]], paints: Iterable[Paint]) -> None:
    """Add the mean red, green and blue of paints, and their number, to the sums of their labels."""
    for label, pixels, mask in paints:
        # Pixels at the rim are mixed with what is beside them.
        core = cv2.erode(mask, _CORE, borderType=cv2.BORDER_CONSTANT, borderValue=0)
        # Those that are cut off at white have another colour than the paint.
        core = cv2.bitwise_and(core, cv2.inRange(pixels, (0.0,) * 3, (_BRIGHT,) * 3))
        blue, green, red, _ = cv2.mean(pixels, core)
        if green:
            of_label = sums.setdefault(label, [0.0, 0.0, 0.0, 0.0])
            for place, value in enumerate((red, green, blue, 1.0)):
                of_label[place] += value


def _moved(table: ColorTable, sums: dict[int, list[float]]) -> FloatArray:
    """Return by how much ln(R/G) and ln(B/G) of each paint have grown, (n, 2); NaN where it is too dark or cut off."""
    seen = np.array(list(sums.values())).reshape(-1, 4)
    seen = seen[:, :3] / seen[:, 3:]
    there = table.middles[np.array(list(sums), dtype=int) - 1]
    # What is nearly black or saturated in one light says nothing of another.
    known = (np.minimum(seen, there) > _DARK) & (np.maximum(seen, there) < _BRIGHT)
    grown = np.log(np.maximum(seen, 1.0) / np.maximum(there, 1.0))
    moved: FloatArray = np.where(known[:, [0, 2]] & known[:, [1]], grown[:, [0, 2]] - grown[:, [1]], np.nan)
    return moved


def _near(moved: FloatArray, shift: FloatArray, limit: float) -> int:
    """Return how many paints, (n, 2) with NaN, are within a limit of a light in all of them that can be measured."""
    return int((~(np.abs(moved - shift) > limit).any(axis=1) & ~np.isnan(moved).all(axis=1)).sum())


def _said(moved: FloatArray, here: FloatArray) -> FloatArray:
    """Return the light by what most paints say, (n, 2) with NaN; `here`, the one in use, where that is none."""
    shift = np.array([_agreed(of_axis, at) for of_axis, at in zip(moved.T, here, strict=True)])
    return np.clip(shift, -_MOST, _MOST) if abs(shift.sum()) < _TINT else here


def _agreed(moved: FloatArray, here: float) -> float:
    """Return what most paints say of one ratio, (n,) with NaN; `here`, what holds now, where they say nothing else."""
    moved = moved[~np.isnan(moved)]
    if not len(moved):
        return here
    off = np.abs(moved - np.median(moved))
    agree = off < _AGREE
    if agree.sum() < max(_LEAST_PAINTS, 0.5 * len(moved)):
        return here
    mean = float(moved[agree].mean())
    # What is twice as far as the paints scatter (normal: 1.48 median deviations) is no chance.
    return mean if abs(mean - here) > 2.0 * 1.48 * np.median(off) / np.sqrt(len(off)) else here
