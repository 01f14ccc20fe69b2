"""How far a camera's automatic settings have carried its pictures since the session began.

Colours are learned once, with locked settings. Where a driver does not lock one, the same scene changes its brightness
and colour. This measures how much, by the median of a grid of pixels' ratios to the first picture: what stands still
decides it, and hands come and go.
"""

from __future__ import annotations

from typing import Final

import numpy as np

from rhot.arrays import FloatArray, ImageArray

_STEP: Final = 16
"""Pixels between two that are looked at: 1,200 of 640x480."""
_DARK, _BRIGHT = 16, 235
"""Between these a pixel's value says how much light came: darker is noise, brighter is cut off."""
_ENOUGH: Final = 50
"""Pixels for a median to within a percent, at 5 % of noise each."""


class Drift:
    """Compares pictures with the first one."""

    def __init__(self) -> None:
        self._first: FloatArray | None = None
        self._ratios = np.ones(3)

    def see(self, image: ImageArray) -> None:
        """Take a picture, (H, W, 3) uint8 BGR."""
        pixels = image[::_STEP, ::_STEP].reshape(-1, 3).astype(float)
        if self._first is None or self._first.shape != pixels.shape:
            self._first = pixels
            return
        usable = np.all((self._first > _DARK) & (self._first < _BRIGHT) & (pixels > _DARK) & (pixels < _BRIGHT), axis=1)
        if np.count_nonzero(usable) >= _ENOUGH:
            self._ratios = np.median(pixels[usable] / self._first[usable], axis=0)

    @property
    def brightness(self) -> float:
        """Change of brightness, as a share: 0.1 is a tenth brighter than at first."""
        return float(np.exp(np.mean(np.log(self._ratios)))) - 1.0

    @property
    def colour(self) -> float:
        """Largest change of a channel beside that of brightness, as a share."""
        return float(np.max(np.abs(self._ratios / (1.0 + self.brightness) - 1.0)))
