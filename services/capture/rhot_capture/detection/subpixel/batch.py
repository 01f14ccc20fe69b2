"""Grids of about one size in one array: which pixels are rim, pure paint and surroundings, and the sums over them.

A frame holds a few thousand such pixels, so what costs time is the number of calls and not that of pixels: each step
is one call for all markers, neighbours are found in sets of pixels that are one number each, sums over places are
products of matrices, and colours lie in planes, as numpy is several times as fast along long rows.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache
from typing import Final, cast

import numpy as np

from rhot_capture.detection.color_table import ImageArray
from rhot_capture.detection.subpixel.pixel_sets import (
    bits_of,
    grown_by_cross,
    grown_by_square,
    pixels_of,
    shrunk_by_cross,
    shrunk_by_square,
)
from rhot_capture.detection.subpixel.shares import LEAST, MIN_STEP, MOST, CoverageArray
from rhot_capture.detection.subpixel.unmixing import Levels, Line
from rhot_capture.detection.subpixel.windows import Grid

Sums = tuple[float, float, float]

ROUND_GAIN: Final = 1.4
_MARGIN_PX: Final = 3
"""Below and beside each window, so that none is within reach of the next one's blob."""
_UNKNOWN: Final = 1
_MIN_CORE_SHARE: Final = 0.08
_LARGE_PX: Final = 64
"""From this many pixels on unlabelled paint beside a blob is taken back."""
_TAKEN_BACK: Final = np.float32(0.4)
"""t from which an unlabelled pixel beside a large blob is paint: the darkest shadow that is still told from a rim."""
_GROWN_MUCH: Final = 1.15
"""Only what motion smears or shade hides would grow by more, by what is taken back; else the mask is left as it is."""


class Batch:
    """Grids in one array; H and W hold the largest and a margin below and beside it.

    Attributes:
        shape: N, H and W.
        colours: (N, 4, H·W) float32: blue, green, red, 1.
        places: (6, H·W) float32: 1, x, y from the middle, x², xy, y².
        area: (N,) pixels inside the blobs.
        weights: (N, 2, H·W) float32, 1 in the surroundings, which hold no paint, and in the core. The core is where
            paint is pure; the whole blob where it is too small for rim and core.
        sums: (N, 2, 6), of `places` by `weights`.
    """

    def __init__(self, grids: Sequence[Grid]) -> None:
        count = len(grids)
        sizes = [grid.mask.shape for grid in grids]
        height = max([size[0] for size in sizes]) + _MARGIN_PX
        width = max([size[1] for size in sizes]) + _MARGIN_PX
        self.shape = count, height, width
        masks: ImageArray = np.full(self.shape, _UNKNOWN, np.uint8)
        # What no window fills counts nowhere, whatever it is.
        pixels: ImageArray = np.empty((count, height, width, 3), np.uint8)
        for place, (grid, (rows, columns)) in enumerate(zip(grids, sizes, strict=True)):
            masks[place, :rows, :columns] = grid.mask
            pixels[place, :rows, :columns] = grid.image
        size = height * width
        self.colours: CoverageArray = np.empty((count, 4, size), np.float32)
        self.colours[:, 3] = 1.0
        self.colours[:, :3] = pixels.reshape(count, size, 3).transpose(0, 2, 1)
        self._weighted: CoverageArray = np.empty((count, 5, size), np.float32)
        self.places = _places(height, width)
        self._gain, self._most = _gains(tuple([grid.window.round_part for grid in grids]))
        # Sets of pixels; those of window k begin at bit k · H · W.
        self._starts = range(0, count * size, size)
        self._whole = (1 << size) - 1
        self._coarse = sum(
            [self._whole << start for grid, start in zip(grids, self._starts, strict=True) if grid.scale > 1]
        )
        self._inside = bits_of(masks > _UNKNOWN)
        # What is not 0 is inside or not known.
        self._known = self._inside | (((1 << count * size) - 1) ^ bits_of(masks))
        self._look_around()

    @property
    def middle(self) -> tuple[float, float]:
        """Where places are counted from, x and y."""
        _, height, width = self.shape
        return 0.5 * (width - 1), 0.5 * (height - 1)

    def _counts(self, bits: int) -> list[int]:
        """Return how many pixels of each window are in a set."""
        return [(bits >> start & self._whole).bit_count() for start in self._starts]

    def _look_around(self) -> None:
        """Find core and surroundings of the blobs as they are now."""
        width = self.shape[2]
        inside, coarse = self._inside, self._coarse
        # Up to 2.5 pixels from the blob there may be paint, and 2 pixels from what is not the blob it is pure; on a
        # coarser grid 2 of its pixels, and 1.5.
        near = grown_by_cross(inside, width)
        deep = shrunk_by_cross(inside, width)
        reach, pure = grown_by_square(near, width), shrunk_by_cross(deep, width)
        if coarse:
            reach ^= (reach ^ grown_by_cross(near, width)) & coarse
            pure ^= (pure ^ shrunk_by_square(inside, width)) & coarse
        reach &= self._known
        core = pure
        self.area = self._counts(inside)
        for start, area, pixels in zip(self._starts, self.area, self._counts(pure), strict=True):
            # A blob large enough has a core that is.
            if area < _LARGE_PX and pixels <= _MIN_CORE_SHARE * area:
                own = self._whole << start
                narrow = deep & own
                if narrow.bit_count() <= _MIN_CORE_SHARE * area:
                    narrow = 0
                pure ^= (pure & own) ^ narrow
                core ^= (core & own) ^ (narrow or inside & own)
        planes = self._planes(self._known ^ reach, core, reach ^ pure, pure)
        self.weights: CoverageArray = self._weighted[:, :2]
        self.weights[:] = planes[:2].transpose(1, 0, 2)
        self._rim, self._pure = planes[2:]
        self.sums: list[list[list[float]]] = (self.weights @ self.places.T).tolist()

    def _planes(self, *sets: int) -> CoverageArray:
        """Return for each set of pixels (N, H·W) float32, 1 in it, else 0."""
        count, height, width = self.shape
        size = count * height * width
        bits = sum([each << place * size for place, each in enumerate(sets)])
        planes: CoverageArray = pixels_of(bits, len(sets) * size).astype(np.float32)
        return planes.reshape((len(sets), count, height * width))

    @property
    def insides(self) -> CoverageArray:
        """(N, H·W) float32, 1 inside the blobs."""
        planes = self._planes(self._inside)
        insides: CoverageArray = planes[0]
        return insides

    def color_sums(self) -> list[list[list[float]]]:
        """Return the sums that `rhot_capture.detection.subpixel.unmixing.projection` asks for.

        Returns:
            (N, 5, 4) of blue, green, red, 1: over the surroundings, over the core, and times blue, green, red over
            the surroundings.
        """
        np.multiply(self.colours[:, :3], self._weighted[:, :1], out=self._weighted[:, 2:])
        sums: list[list[list[float]]] = (self._weighted @ self.colours.transpose(0, 2, 1)).tolist()
        return sums

    def projected(self, lines: Sequence[Line]) -> CoverageArray:
        """Return t of every pixel, (N, H·W).

        Args:
            lines: N times t of blue, green, red, 1.
        """
        t: CoverageArray = (np.array(lines, np.float32)[:, None] @ self.colours)[:, 0]
        return t

    def take_back(self, t: CoverageArray) -> bool:
        """Add to the masks of large blobs what t tells to be paint beside them; return whether any has grown much.

        Args:
            t: (N, H·W).
        """
        if max(self.area) < _LARGE_PX:
            return False
        width = self.shape[2]
        # Three pixels around; more than the rim, as it is no rim.
        near = grown_by_cross(grown_by_square(grown_by_cross(self._inside, width), width), width)
        taken = bits_of(t > _TAKEN_BACK) & near & self._known | self._inside
        has_grown = False
        for start, area, pixels in zip(self._starts, self.area, self._counts(taken), strict=True):
            if area >= _LARGE_PX and pixels >= _GROWN_MUCH * area:
                self._inside |= taken & self._whole << start
                has_grown = True
        if has_grown:
            self._look_around()
        return has_grown

    def products(self, t: CoverageArray) -> tuple[list[list[list[float]]], list[float]]:
        """Return the sums that `rhot_capture.detection.subpixel.unmixing.fitted_levels` asks for.

        Args:
            t: (N, H·W).

        Returns:
            (N, 2, 3) sums of the products of t with 1, x, y over surroundings and core; (N,) of t² over the core.
        """
        weighted = self.weights * t[:, None]
        return (weighted @ self.places[:3].T).tolist(), np.vecdot(weighted[:, 1], t).tolist()

    def shares(self, t: CoverageArray, levels: Sequence[Levels]) -> CoverageArray:
        """Return the painted share of every pixel as it comes out, (N, H·W).

        Args:
            t: (N, H·W).
            levels: N planes outside and inside.
        """
        planes = [each.outside for each in levels] + [each.inside for each in levels]
        found = np.array(planes, np.float32) @ self.places[:3]
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
        sums = cast(list[Sums], (counted @ self.places[:3].T).tolist())
        return list(zip((share @ self.places[0]).tolist(), sums, strict=True))


@lru_cache(maxsize=256)
def _gains(round_parts: tuple[bool, ...]) -> tuple[CoverageArray, CoverageArray]:
    """Return the (N, 1) gain of a share, and the most that one counts for."""
    gains = [(ROUND_GAIN, 1.0) if is_round else (1.0, float(MOST)) for is_round in round_parts]
    gain, most = np.array(gains, np.float32).T[:, :, None]
    return gain, most


@lru_cache(maxsize=256)
def _places(height: int, width: int) -> CoverageArray:
    """Return 1, x, y, x², xy, y² of the pixels of a window, counted from its middle, (6, height · width)."""
    y, x = np.indices((height, width), np.float32).reshape(2, -1)
    x, y = x - np.float32(0.5 * (width - 1)), y - np.float32(0.5 * (height - 1))
    places = np.array([np.ones_like(x), x, y, x * x, x * y, y * y])
    places.setflags(write=False)
    return places
