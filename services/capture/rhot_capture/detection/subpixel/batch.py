"""Grids of about one size in one array: which pixels are rim, pure paint and surroundings, and the sums over them.

A frame holds a few thousand such pixels, so what costs time is the number of calls and not that of pixels: each step
is one call for all markers, sums over positions are products of matrices, and colours lie in planes, as numpy is
several times as fast along long rows.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache
from typing import Final, cast

import cv2
import numpy as np
from numpy.typing import ArrayLike

from rhot.arrays import ImageArray
from rhot_capture.detection.subpixel.shares import LEAST, MIN_STEP, MOST, CoverageArray
from rhot_capture.detection.subpixel.windows import Grid

Sums = tuple[float, float, float]

# How these were chosen is not recorded; tests/capture/test_simulated_accuracy.py limits the error that they leave.
ROUND_GAIN: Final = 1.4
"""Times a share of something round, whose shaded edge looks like a mixture with a dark background."""
_MARGIN_PX: Final = 3
"""Below and beside each window, so that none is within reach of the next one's blob."""
_MIN_CORE_SHARE: Final = 0.08
"""Of a blob's pixels: with fewer pure ones, the core reaches closer to the rim."""
_LARGE_PX: Final = 64
"""From this many pixels on unlabelled paint beside a blob is taken back."""
_TAKEN_BACK: Final = np.float32(0.4)
"""t from which an unlabelled pixel beside a large blob is paint: the darkest shadow that still differs from a rim."""
_GROWN_MUCH: Final = 1.15
"""Only what motion smears or shade hides would grow by more, by what is taken back; else the mask is left as it is."""

# Neighbourhoods: the next pixel, up to 2.5 pixels away, and by 2 steps away.
_SQUARE: Final = np.ones((3, 3), np.uint8)
_CROSS: Final = np.asarray(cv2.getStructuringElement(cv2.MORPH_CROSS, (3, 3)), dtype=np.uint8)
_WITHIN_2_5: Final = np.asarray(cv2.dilate(np.pad(_CROSS, 1), _SQUARE), dtype=np.uint8)
_TWO_STEPS: Final = np.asarray(cv2.dilate(np.pad(_CROSS, 1), _CROSS), dtype=np.uint8)


class Batch:
    """Grids in one array; H and W hold the largest and a margin below and beside it.

    Attributes:
        shape: N, H and W.
        colours: (N, 4, H·W) float32: blue, green, red, 1.
        monomials: (6, H·W) float32: 1, x, y from the middle, x², xy, y².
        area: (N,) pixels inside the blobs.
        weights: (N, 2, H·W) float32, 1 in the surroundings, which hold no paint, and in the core. The core is where
            paint is pure; the whole blob where it is too small for rim and core.
        sums: (N, 2, 6) float32, of `monomials` by `weights`.
    """

    def __init__(self, grids: Sequence[Grid]) -> None:
        count = len(grids)
        sizes = [grid.mask.shape for grid in grids]
        height = max([size[0] for size in sizes]) + _MARGIN_PX
        width = max([size[1] for size in sizes]) + _MARGIN_PX
        self.shape = count, height, width
        # 1 inside the blobs, and 1 where a window is.
        self._inside: ImageArray = np.zeros(self.shape, np.uint8)
        self._known: ImageArray = np.zeros(self.shape, np.uint8)
        # What no window fills counts nowhere, whatever it is.
        pixels: ImageArray = np.empty((count, height, width, 3), np.uint8)
        for k, (grid, (rows, columns)) in enumerate(zip(grids, sizes, strict=True)):
            self._inside[k, :rows, :columns] = grid.mask
            self._known[k, :rows, :columns] = 1
            pixels[k, :rows, :columns] = grid.image
        self._inside &= 1
        size = height * width
        self.colours: CoverageArray = np.empty((count, 4, size), np.float32)
        self.colours[:, 3] = 1.0
        self.colours[:, :3] = pixels.reshape(count, size, 3).transpose(0, 2, 1)
        self._weighted: CoverageArray = np.empty((count, 5, size), np.float32)
        self.monomials = _monomials(height, width)
        self._gain, self._most = _gains(tuple([grid.window.round_part for grid in grids]))
        self._is_coarse = [grid.scale > 1 for grid in grids]
        self._near: ImageArray = np.empty(self.shape, np.uint8)
        self.area = [0] * count
        self.weights: CoverageArray = self._weighted[:, :2]
        self._rim: CoverageArray = np.empty((count, size), np.float32)
        self._pure: CoverageArray = np.empty((count, size), np.float32)
        self.sums: CoverageArray = np.empty((count, 2, len(self.monomials)), np.float32)
        self._look_around(range(count))

    @property
    def middle(self) -> tuple[float, float]:
        """Where positions are counted from, x and y."""
        _, height, width = self.shape
        return 0.5 * (width - 1), 0.5 * (height - 1)

    def _look_around(self, changed: Sequence[int]) -> None:
        """Find core and surroundings of some blobs, in ascending order, as they are now."""
        _, height, width = self.shape
        count = len(changed)
        # A slice takes no copy.
        which = list(changed) if count < len(self.area) else slice(None)
        inside, known = self._inside[which], self._known[which]
        stacked, shape = inside.reshape(-1, width), inside.shape
        # Up to 2.5 pixels from the blob there may be paint, and 2 pixels from what is not the blob it is pure; on a
        # coarser grid 2 of its pixels, and 1.5.
        near = np.asarray(cv2.dilate(stacked, _WITHIN_2_5), dtype=np.uint8).reshape(shape)
        reach = near & known
        pure = _eroded(stacked, _TWO_STEPS).reshape(shape)
        core = pure.copy()
        for row, k in enumerate(changed):
            if self._is_coarse[k]:
                reach[row] = cv2.dilate(inside[row], _TWO_STEPS) & known[row]
                core[row] = pure[row] = _eroded(inside[row], _SQUARE)
            self.area[k] = area = cv2.countNonZero(inside[row])
            # A blob large enough has a core that is.
            if area < _LARGE_PX and cv2.countNonZero(pure[row]) <= _MIN_CORE_SHARE * area:
                narrow = _eroded(inside[row], _CROSS)
                if cv2.countNonZero(narrow) > _MIN_CORE_SHARE * area:
                    core[row] = pure[row] = narrow
                else:
                    core[row], pure[row] = inside[row], 0
        planes: CoverageArray = np.array([known ^ reach, core, reach ^ pure, pure], np.float32)
        planes = planes.reshape(4, count, height * width)
        weights = planes[:2].transpose(1, 0, 2)
        self._near[which], self.weights[which] = near, weights
        self._rim[which], self._pure[which] = planes[2:]
        self.sums[which] = weights @ self.monomials.T

    @property
    def insides(self) -> CoverageArray:
        """(N, H·W) float32, 1 inside the blobs."""
        return self._inside.reshape(self.shape[0], -1).astype(np.float32)

    def color_sums(self) -> CoverageArray:
        """Return the sums that `rhot_capture.detection.subpixel.unmixing.projections` asks for.

        Returns:
            (N, 5, 4) float32, of blue, green, red, 1: over the surroundings, over the core, and times blue, green, red
            over the surroundings.
        """
        np.multiply(self.colours[:, :3], self._weighted[:, :1], out=self._weighted[:, 2:])
        sums: CoverageArray = self._weighted @ self.colours.transpose(0, 2, 1)
        return sums

    def projected(self, lines: ArrayLike) -> CoverageArray:
        """Return t of every pixel, (N, H·W).

        Args:
            lines: (N, 4), t of blue, green, red, 1.
        """
        t: CoverageArray = (np.array(lines, np.float32)[:, None] @ self.colours)[:, 0]
        return t

    def take_back(self, t: CoverageArray, rounds: int) -> None:
        """Add to the masks of large blobs what t shows to be paint beside them, as long as one grows much by it.

        Args:
            t: (N, H·W).
            rounds: how often at most.
        """
        growing = [k for k, area in enumerate(self.area) if area >= _LARGE_PX]
        if not growing:
            return
        paint = (t > _TAKEN_BACK).view(np.uint8).reshape(self.shape) & self._known
        for _ in range(rounds):
            growing = [k for k in growing if self._grow(k, paint[k])]
            if not growing:
                break
            self._look_around(growing)

    def _grow(self, k: int, paint: ImageArray) -> bool:
        """Add paint (H, W) to the mask of a blob if it grows much by what lies about it; tell whether it does."""
        much = _GROWN_MUCH * self.area[k]
        if cv2.countNonZero(paint | self._inside[k]) < much:
            return False
        # Three pixels around; more than the rim, as it is no rim.
        about = np.asarray(cv2.dilate(self._near[k], _CROSS), dtype=np.uint8)
        grown = paint & about | self._inside[k]
        if cv2.countNonZero(grown) < much:
            return False
        self._inside[k] = grown
        return True

    def products(self, t: CoverageArray) -> tuple[CoverageArray, CoverageArray]:
        """Return the sums that `rhot_capture.detection.subpixel.unmixing.fitted_levels` asks for.

        Args:
            t: (N, H·W).

        Returns:
            (N, 2, 3) float32 sums of the products of t with 1, x, y over surroundings and core; (N,) of t² over the
            core.
        """
        weighted: CoverageArray = self.weights * t[:, None]
        products: CoverageArray = weighted @ self.monomials[:3].T
        return products, np.vecdot(weighted[:, 1], t)

    def shares(self, t: CoverageArray, planes: ArrayLike) -> CoverageArray:
        """Return the painted share of every pixel as it comes out, (N, H·W).

        Args:
            t: (N, H·W).
            planes: (2·N, 3), coefficients of 1, x, y: first N levels outside, then N inside.
        """
        found = np.array(planes, np.float32) @ self.monomials[:3]
        outside, step = found[: len(t)], found[len(t) :]
        step -= outside
        np.maximum(step, MIN_STEP, out=step)
        share: CoverageArray = t - outside
        share /= step
        return share

    def tidy(self, share: CoverageArray) -> None:
        """Bound shares (N, H·W); beyond the reach there is no paint, and pure paint is nothing else."""
        share.clip(LEAST, MOST, out=share)
        share *= self._rim
        share += self._pure

    def totals(self, share: CoverageArray) -> list[tuple[float, Sums]]:
        """Return per window the sum of shares, and the sums of 1, x, y by what counts of a share for the centre.

        Args:
            share: (N, H·W).
        """
        counted = share * self._gain
        np.minimum(counted, self._most, out=counted)
        sums = cast(list[Sums], (counted @ self.monomials[:3].T).tolist())
        return list(zip((share @ self.monomials[0]).tolist(), sums, strict=True))


def _eroded(mask: ImageArray, kernel: ImageArray) -> ImageArray:
    """Return a mask without the pixels that have one outside of it, or of the picture, in their neighbourhood."""
    return np.asarray(cv2.erode(mask, kernel, borderType=cv2.BORDER_CONSTANT, borderValue=0), dtype=np.uint8)


@lru_cache(maxsize=256)
def _gains(round_parts: tuple[bool, ...]) -> tuple[CoverageArray, CoverageArray]:
    """Return the (N, 1) gain of a share, and the most that one counts for."""
    gains = [(ROUND_GAIN, 1.0) if is_round else (1.0, float(MOST)) for is_round in round_parts]
    gain, most = np.array(gains, np.float32).T[:, :, None]
    return gain, most


@lru_cache(maxsize=256)
def _monomials(height: int, width: int) -> CoverageArray:
    """Return 1, x, y, x², xy, y² of the pixels of a window, counted from its middle, (6, height · width)."""
    y, x = np.indices((height, width), np.float32).reshape(2, -1)
    x, y = x - np.float32(0.5 * (width - 1)), y - np.float32(0.5 * (height - 1))
    monomials = np.array([np.ones_like(x), x, y, x * x, x * y, y * y])
    monomials.setflags(write=False)
    return monomials
