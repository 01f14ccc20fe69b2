"""Grids of about one size in one array: which pixels are rim, pure paint and surroundings, and the sums over them.

A frame holds a few thousand such pixels, so what costs time is the number of calls and not that of pixels: each step
is one call for all markers, sums over places are products of matrices, and colours lie in planes, as numpy is several
times as fast along long rows.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache
from typing import Final, cast

import cv2
import numpy as np
from numpy.typing import NDArray

from rhot_capture.color_table import ImageArray
from rhot_capture.shares import LEAST, MIN_STEP, MOST, CoverageArray
from rhot_capture.unmixing import Levels, Line
from rhot_capture.windows import Grid

BoolArray = NDArray[np.bool_]
Sums = tuple[float, float, float]

ROUND_GAIN: Final = 1.4
_MARGIN_PX: Final = 3
"""Below each window, so that none is within reach of the next one's blob."""
_UNKNOWN: Final = 1
_OUTSIDE_PX: Final = 2.5
"""Distance from the blob, pixel centre to pixel centre, from which on there is no paint."""
_TAKEN_BACK_PX: Final = np.float32(3.0)
"""Distance from the blob up to which unlabelled paint is taken back; more than the rim, as it is no rim."""
_INSIDE_PX: Final = 1.95
"""Distance from what is not the blob beyond which paint is pure."""
_NARROW_PX: Final = 1.0
"""The same for a blob so small that hardly a pixel is that far inside."""
_COARSE_OUTSIDE: Final = 1.95
_COARSE_INSIDE: Final = 1.0
"""Both distances on a coarser grid, in its pixels."""
_MIN_CORE_SHARE: Final = 0.08
_LARGE_PX: Final = 64
"""From this many pixels on unlabelled paint beside a blob is taken back."""
_TAKEN_BACK: Final = np.float32(0.4)
"""t from which an unlabelled pixel beside a large blob is paint: the darkest shadow that is still told from a rim."""
_GROWN_MUCH: Final = 1.15
"""Only what motion smears or shade hides would grow by more, by what is taken back; else the mask is left as it is."""


class Batch:
    """Grids in one array; H and W hold the largest and a margin below it.

    Attributes:
        grids: the grids.
        inside: (N, H, W) uint8, 1 inside the blobs.
        known: (N, H, W) bool, where there is a picture.
        colours: (N, 4, H·W) float32: blue, green, red, 1.
        places: (H·W, 6) float32: 1, x, y from the middle, x², xy, y².
        distance: (N, H, W) float32, to the blob.
        reach: (N, H, W) bool, where there may be paint.
        pure: (N, H, W) bool, where the paint is surely pure.
        weights: (N, 3, H·W) float32, 1 in the surroundings, which hold no paint, in the core and inside the blobs. The
            core is where paint is pure; the whole blob where it is too small for rim and core.
        sums: (N, 3, 6) float32, of `places` by `weights`.
    """

    def __init__(self, grids: Sequence[Grid]) -> None:
        self.grids = grids
        count = len(grids)
        sizes = [grid.mask.shape for grid in grids]
        height = max([size[0] for size in sizes]) + _MARGIN_PX
        width = max([size[1] for size in sizes])
        masks: ImageArray = np.full((count, height, width), _UNKNOWN, np.uint8)
        # What no window fills counts nowhere, whatever it is.
        pixels: ImageArray = np.empty((count, height, width, 3), np.uint8)
        for place, (grid, (rows, columns)) in enumerate(zip(grids, sizes, strict=True)):
            masks[place, :rows, :columns] = grid.mask
            pixels[place, :rows, :columns] = grid.image
        self.known: BoolArray = masks != _UNKNOWN
        self.inside: ImageArray = (masks > _UNKNOWN).view(np.uint8)
        self.colours: CoverageArray = np.empty((count, 4, height * width), np.float32)
        self.colours[:, 3] = 1.0
        self.colours[:, :3] = pixels.reshape(count, height * width, 3).transpose(0, 2, 1)
        self.places = _places(height, width)
        self.weights: CoverageArray = np.empty((count, 3, height * width), np.float32)
        self._rules = _rules(tuple([(grid.scale, grid.window.round_part) for grid in grids]))
        self.look_around()

    @property
    def middle(self) -> tuple[float, float]:
        """Where places are counted from, x and y."""
        _, height, width = self.inside.shape
        return 0.5 * (width - 1), 0.5 * (height - 1)

    def look_around(self) -> None:
        """Find core and surroundings of the blobs as their masks are now."""
        count, height, width = shape = self.inside.shape
        strip = self.inside.reshape(count * height, width)
        depth = cv2.distanceTransform(strip, cv2.DIST_L2, 3).reshape(shape)
        distance = cv2.distanceTransform(strip ^ 1, cv2.DIST_L2, 3)
        self.distance: CoverageArray = np.asarray(distance, dtype=np.float32).reshape(shape)
        outside, inside, _, _ = self._rules
        self.reach: BoolArray = (self.distance < outside) & self.known
        self.pure: BoolArray = depth > inside
        self.weights[:, 0] = (self.known ^ self.reach).reshape(count, -1)
        self.weights[:, 1] = self.pure.reshape(count, -1)
        self.weights[:, 2] = self.inside.reshape(count, -1)
        sums = self.weights.reshape(3 * count, height * width) @ self.places
        self.sums: CoverageArray = sums.reshape(count, 3, -1)
        self.area: list[float] = self.sums[:, 2, 0].tolist()
        core: list[float] = self.sums[:, 1, 0].tolist()
        # A blob large enough has a core that is.
        small = [k for k, area in enumerate(self.area) if area < _LARGE_PX and core[k] <= _MIN_CORE_SHARE * area]
        for place in small:
            narrow = depth[place] > _NARROW_PX
            holds = bool(np.count_nonzero(narrow) > _MIN_CORE_SHARE * self.area[place])
            self.pure[place] = narrow if holds else False
            self.weights[place, 1] = (narrow if holds else self.inside[place]).reshape(-1)
            self.sums[place, 1] = self.weights[place, 1] @ self.places

    def color_sums(self) -> list[tuple[list[list[float]], list[list[float]]]]:
        """Return the sums that `rhot_capture.unmixing.projection` asks for.

        Returns:
            for each window (2, 4) of blue, green, red, 1 over surroundings and core, and (3, 3) of the products of
            blue, green, red over the surroundings.
        """
        planes = self.colours.transpose(0, 2, 1)
        colours = self.weights[:, :2] @ planes
        squares = (self.colours[:, :3] * self.weights[:, :1]) @ planes[:, :, :3]
        return list(zip(colours.tolist(), squares.tolist(), strict=True))

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
        taken = t.reshape(self.inside.shape) > _TAKEN_BACK
        taken &= self.distance < _TAKEN_BACK_PX
        taken &= self.known
        taken |= self.inside.view(np.bool_)
        has_grown = False
        for place, area in enumerate(self.area):
            if area >= _LARGE_PX and np.count_nonzero(taken[place]) >= _GROWN_MUCH * area:
                self.inside[place] = taken[place]
                has_grown = True
        if has_grown:
            self.look_around()
        return has_grown

    def products(self, t: CoverageArray) -> tuple[list[list[list[float]]], list[float]]:
        """Return the sums that `rhot_capture.unmixing.fitted_levels` asks for.

        Args:
            t: (N, H·W).

        Returns:
            (N, 2, 3) sums of the products of t with 1, x, y over surroundings and core; (N,) of t² over the core.
        """
        count, size = t.shape
        weighted = self.weights[:, :2] * t[:, None]
        products = weighted.reshape(2 * count, size) @ self.places[:, :3]
        return products.reshape(count, 2, 3).tolist(), np.vecdot(weighted[:, 1], t).tolist()

    def shares(self, t: CoverageArray, levels: Sequence[Levels]) -> CoverageArray:
        """Return the painted share of every pixel as it comes out, (N, H·W).

        Args:
            t: (N, H·W).
            levels: N planes outside and inside.
        """
        planes = [each.outside for each in levels] + [each.inside for each in levels]
        found = np.array(planes, np.float32) @ self.places[:, :3].T
        outside, step = found[: len(t)], found[len(t) :]
        step -= outside
        np.maximum(step, MIN_STEP, out=step)
        share: CoverageArray = t - outside
        share /= step
        return share

    def tidy(self, share: CoverageArray) -> None:
        """Bound shares (N, H·W); beyond the reach there is no paint, and pure paint is nothing else."""
        np.minimum(share, MOST, out=share)
        np.maximum(share, LEAST, out=share)
        share *= (self.reach ^ self.pure).reshape(share.shape)
        share += self.pure.reshape(share.shape)

    def totals(self, share: CoverageArray) -> list[tuple[float, Sums]]:
        """Return per window the sum of shares, and the sums of 1, x, y by what counts of a share for the centre.

        Args:
            share: (N, H·W).
        """
        _, _, gain, most = self._rules
        counted = share * gain
        np.minimum(counted, most, out=counted)
        sums = counted @ self.places[:, :3]
        return list(zip(np.add.reduce(share, axis=1).tolist(), cast(list[Sums], sums.tolist()), strict=True))


@lru_cache(maxsize=256)
def _rules(
    kinds: tuple[tuple[int, bool], ...],
) -> tuple[CoverageArray, CoverageArray, CoverageArray, CoverageArray]:
    """Return what depends on the scale of grids and on whether parts are round.

    Returns:
        (N, 1, 1) distances outside and inside of the rim; (N, 1) gain of a share, and the most that one counts for.
    """
    distances = [(_OUTSIDE_PX, _INSIDE_PX) if scale == 1 else (_COARSE_OUTSIDE, _COARSE_INSIDE) for scale, _ in kinds]
    gains = [(ROUND_GAIN, 1.0) if is_round else (1.0, float(MOST)) for _, is_round in kinds]
    outside, inside = np.array(distances, np.float32).T[:, :, None, None]
    gain, most = np.array(gains, np.float32).T[:, :, None]
    return outside, inside, gain, most


@lru_cache(maxsize=256)
def _places(height: int, width: int) -> CoverageArray:
    """Return 1, x, y, x², xy, y² of the pixels of a window, counted from its middle, (height · width, 6)."""
    y, x = np.indices((height, width), np.float32).reshape(2, -1)
    x, y = x - np.float32(0.5 * (width - 1)), y - np.float32(0.5 * (height - 1))
    places = np.column_stack([np.ones_like(x), x, y, x * x, x * y, y * y])
    places.setflags(write=False)
    return places
