"""Grids of similar size in one array: classification into rim, pure paint and surroundings, and sums over these.

A frame has only a few thousand such pixels, so the number of calls determines the time. Each step is one call for all
markers, sums over positions are matrix products, and colours are stored as planes, because numpy is several times as
fast along long rows.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache
from typing import Final, cast

import cv2
import numpy as np
from numpy.typing import ArrayLike

from rhot.arrays import ImageArray
from rhot_capture.detection.color_table import pack
from rhot_capture.detection.subpixel import windows
from rhot_capture.detection.subpixel.windows import (
    LEAST,
    MIN_STEP,
    MOST,
    BlobWindow,
    Centre,
    CoverageArray,
    Grid,
    Shares,
    grid_of,
    local_share,
)

# Sub-pixel centres of blobs from the painted share of each pixel at the rim.
#
# A pixel at the rim is a mixture of paint and surroundings, and the surroundings may vary, for example from black cloth
# to bright skin. Let c be its colour, P the mean of the pure paint inside, μ and Σ mean and covariance of the colours
# around the blob. The projection t = n·(c − μ) with n = (Σ + σ²I)⁻¹·(P − μ) suppresses the directions in which the
# surroundings vary (the matched filter of spectral unmixing). With its levels outside (t₀) and inside (t₁),
# α = (t − t₀)/(t₁ − t₀) is the painted share of a pixel. The centre is the centroid of α, which symmetric blur does not
# change.
#
# Illumination is uneven, so both levels are planes over the image, fitted to the surroundings and to the pure paint;
# the fits need only the sums of t times 1, x, y over both. Where a plane does not fit the paint of a large blob, as
# at the edge of a shadow, both levels are local means, on the full grid.
#
# Paint in shadow, in a highlight or with motion blur may have no label. Beside a large blob it is added to the mask
# by t, which separates paint from the surroundings better than the label.
#
# As t is linear, the mean of four pixels has their mean share, so large windows are measured on a coarser grid to save
# time. Windows of similar size are copied into one array, so that each step is one call for all of them.

_ALIKE: Final = 2.0
"""Largest ratio between the sizes of windows that are measured together."""
_ROUNDS: Final = 2
"""Largest number of enlargements of a mask."""
_LOCAL_FROM_PX: Final = 600
"""Smallest window for local levels, pixels; smaller ones have too little pure paint on the lit and the shaded side."""


def find_centres(windows: Sequence[BlobWindow], skin: ImageArray | None = None) -> list[Centre]:
    """Return the centres of blobs, in the order of the windows.

    Round surfaces are darker towards their edge, so that paint there looks like a mixture with a dark background, and
    the shaded side would get less weight. Shares of 1 / `ROUND_GAIN` and more therefore count as 1. This corrects most
    of the bias, and moves the rim outwards by the same small amount on all sides.

    Args:
        windows: with a blob each.
        skin: (65536,) uint8, 1 for 5-6-5 colours of skin; None = not known.
    """
    if not windows:
        return []
    grids = [grid_of(window) for window in windows]
    sizes = [grid.mask.size for grid in grids]
    limit = _ALIKE * min(sizes)
    if max(sizes) <= limit:
        return _measure(grids, skin)
    alike = [size <= limit for size in sizes]
    small = iter(find_centres([window for window, is_small in zip(windows, alike, strict=True) if is_small], skin))
    large = iter(find_centres([window for window, is_small in zip(windows, alike, strict=True) if not is_small], skin))
    return [next(small if is_small else large) for is_small in alike]


def _measure(grids: Sequence[Grid], skin: ImageArray | None) -> list[Centre]:
    """Return the centres of the blobs on grids of similar size."""
    batch = Batch(grids)
    lines, usable = windows.projections(batch.color_sums())
    t = batch.projected(lines)
    batch.enlarge(t, _ROUNDS)
    planes, misfits = windows.fitted_levels(lines, batch.sums, *batch.products(t))
    share = batch.shares(t, planes)
    finer: list[int] = []
    for k, (is_usable, misfit) in enumerate(zip(usable, misfits, strict=True)):
        if not is_usable:
            share[k] = batch.insides[k]
        elif misfit and grids[k].window.mask.size >= _LOCAL_FROM_PX:
            if grids[k].scale > 1:
                finer.append(k)
            else:
                share[k] = local_share(t[k], batch.weights[k], batch.shape[1:])
    batch.clip(share)
    totals = batch.totals(share)
    x, y = batch.middle
    # If the painted area is a smaller share of the mask, or the centre is outside the window, the shares are
    # invalid and the mask is used.
    invalid = [
        k
        for k, (painted, (m00, m10, m01)) in enumerate(totals)
        if painted < 0.5 * batch.area[k] or not _within(grids[k], m10 + x * m00, m01 + y * m00, m00)
    ]
    if invalid:
        share[invalid] = batch.insides[invalid]
        totals = batch.totals(share)
    middles = [(m10 / m00, m01 / m00) for _, (m00, m10, m01) in totals]
    sides: list[tuple[tuple[float, float] | None, float]] = [(None, 0.0)] * len(grids)
    if skin is not None:
        found = batch.skin_sides(skin, np.array(middles, np.float32)).tolist()
        sides = [((to_right, down), part) for to_right, down, part in found]
    centres = []
    for k, (grid, (painted, _)) in enumerate(zip(grids, totals, strict=True)):
        window, scale, left, top = grid[:4]
        shares: Shares | None = None
        if window.shared:
            height, width = grid.mask.shape
            own = share[k].reshape(batch.shape[1:])[:height, :width]
            shares = Shares(own, scale, left, top)
        u = left + scale * (middles[k][0] + x + 0.5) - 0.5
        v = top + scale * (middles[k][1] + y + 0.5) - 0.5
        centres.append(Centre(u, v, painted * scale**2, shares, *sides[k]))
    for k in finer:
        # Local means extend over a few pixels, which is too far on a coarser grid.
        (centres[k],) = _measure([grid_of(grids[k].window, coarse=False)], skin)
    return centres


def _within(grid: Grid, m10: float, m01: float, m00: float) -> bool:
    """Return whether a centroid, given by moments about the first pixel, is in the window; the batch may be larger."""
    height, width = grid.mask.shape
    return bool(0.0 <= m10 <= (width - 1) * m00 and 0.0 <= m01 <= (height - 1) * m00)


Sums = tuple[float, float, float]

# How these were chosen is not recorded; tests/capture/test_simulated_accuracy.py limits the resulting error.
ROUND_GAIN: Final = 1.4
"""Factor on the shares of round surfaces, whose shaded edge looks like a mixture with a dark background."""
_MARGIN_PX: Final = 3
"""Margin below and beside each window, so that the neighbourhoods of blobs do not overlap."""
_MIN_CORE_SHARE: Final = 0.08
"""Smallest share of pure pixels in a blob; with fewer, the core extends closer to the rim."""
_LARGE_PX: Final = 64
"""Smallest blob, pixels, whose mask is enlarged by unlabelled paint beside it."""
_UNLABELLED_PAINT: Final = np.float32(0.4)
"""t from which an unlabelled pixel beside a large blob is paint: the darkest shadow that differs from a rim."""

# Neighbourhoods: 8-connected, within 2.5 pixels, and within 2 steps of the 4-connected one.
_SQUARE: Final = np.ones((3, 3), np.uint8)
_CROSS: Final = np.asarray(cv2.getStructuringElement(cv2.MORPH_CROSS, (3, 3)), dtype=np.uint8)
_WITHIN_2_5: Final = np.asarray(cv2.dilate(np.pad(_CROSS, 1), _SQUARE), dtype=np.uint8)
_TWO_STEPS: Final = np.asarray(cv2.dilate(np.pad(_CROSS, 1), _CROSS), dtype=np.uint8)


class Batch:
    """N grids in one array; H and W are those of the largest grid plus a margin.

    Attributes:
        shape: N, H and W.
        colours: (N, 4, H·W) float32: blue, green, red, 1.
        monomials: (6, H·W) float32: 1, x, y relative to the middle, x², xy, y².
        area: (N,) number of pixels inside the blobs.
        weights: (N, 2, H·W) float32, 1 in the surroundings, which contain no paint, and 1 in the core. The core is the
            pure paint, or the whole blob if it is too small for rim and core.
        sums: (N, 2, 6) float32, sums of `monomials` weighted by `weights`.
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
        # Uninitialised pixels outside all windows have weight 0 everywhere.
        pixels: ImageArray = np.empty((count, height, width, 3), np.uint8)
        for k, (grid, (rows, columns)) in enumerate(zip(grids, sizes, strict=True)):
            self._inside[k, :rows, :columns] = grid.mask
            self._known[k, :rows, :columns] = 1
            pixels[k, :rows, :columns] = grid.image
        self._inside &= 1
        self._pixels = pixels
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
        self._update_neighbourhoods(range(count))

    @property
    def middle(self) -> tuple[float, float]:
        """Origin of the positions, x and y."""
        _, height, width = self.shape
        return 0.5 * (width - 1), 0.5 * (height - 1)

    def _update_neighbourhoods(self, changed: Sequence[int]) -> None:
        """Compute core, rim and surroundings of blobs, in ascending order, from their current masks."""
        _, height, width = self.shape
        count = len(changed)
        # A slice makes no copy.
        which = list(changed) if count < len(self.area) else slice(None)
        inside, known = self._inside[which], self._known[which]
        stacked, shape = inside.reshape(-1, width), inside.shape
        # The rim extends from 2.5 pixels outside the blob to 2 pixels inside; on a coarser grid 2 and 1.5 of its cells.
        near = np.asarray(cv2.dilate(stacked, _WITHIN_2_5), dtype=np.uint8).reshape(shape)
        reach = near & known
        pure = _eroded(stacked, _TWO_STEPS).reshape(shape)
        core = pure.copy()
        for row, k in enumerate(changed):
            if self._is_coarse[k]:
                reach[row] = cv2.dilate(inside[row], _TWO_STEPS) & known[row]
                core[row] = pure[row] = _eroded(inside[row], _SQUARE)
            self.area[k] = area = cv2.countNonZero(inside[row])
            # The core of a large blob is always large enough.
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

    def skin_sides(self, skin: ImageArray, centres: CoverageArray) -> CoverageArray:
        """Return where skin adjoins each blob, see `rhot.messages.Marker`.

        Unit vectors are approximated by vectors divided by the root mean square of their lengths, which makes all sums
        matrix products.

        Args:
            skin: (65536,) uint8, 1 for 5-6-5 colours of skin.
            centres: (N, 2) relative to the middle.

        Returns:
            (N, 3) x and y, and the share of the ring that is skin.
        """
        count, height, width = self.shape
        packed = pack(self._pixels.reshape(-1, width, 3))
        colours = np.asarray(cv2.LUT(packed, skin), dtype=np.uint8).reshape(self.shape)
        near = self._near.copy()
        for k, is_coarse in enumerate(self._is_coarse):
            if is_coarse:
                # The margin of a window is only three cells of the coarse grid wide.
                cv2.dilate(self._inside[k], _CROSS, dst=near[k])
        around = np.asarray(cv2.dilate(near.reshape(-1, width), _TWO_STEPS), dtype=np.uint8).reshape(self.shape)
        ring = (around ^ near) & self._known
        planes: CoverageArray = np.array([ring, ring & colours], np.float32).reshape(2, count, height * width)
        ring_sums, skin_sums = planes @ self.monomials.T
        number = np.maximum(ring_sums[:, 0], 1.0)
        squares = ring_sums[:, 3] + ring_sums[:, 5] - 2.0 * np.vecdot(centres, ring_sums[:, 1:3])
        radius = np.sqrt(np.maximum(squares / number + np.vecdot(centres, centres), 1.0))
        sides: CoverageArray = np.empty((count, 3), np.float32)
        sides[:, :2] = (skin_sums[:, 1:3] - skin_sums[:, :1] * centres) / (number * radius)[:, None]
        sides[:, 2] = skin_sums[:, 0] / number
        return sides

    def color_sums(self) -> CoverageArray:
        """Return the sums for `rhot_capture.detection.subpixel.windows.projections`.

        Returns:
            (N, 5, 4) float32, sums of blue, green, red, 1: over the surroundings; over the core; over the surroundings
            times blue, green and red.
        """
        np.multiply(self.colours[:, :3], self._weighted[:, :1], out=self._weighted[:, 2:])
        sums: CoverageArray = self._weighted @ self.colours.transpose(0, 2, 1)
        return sums

    def projected(self, lines: ArrayLike) -> CoverageArray:
        """Return t of every pixel, (N, H·W).

        Args:
            lines: (N, 4), coefficients of t for blue, green, red, 1.
        """
        t: CoverageArray = (np.array(lines, np.float32)[:, None] @ self.colours)[:, 0]
        return t

    def enlarge(self, t: CoverageArray, rounds: int) -> None:
        """Add adjacent paint, as indicated by t, to the masks of large blobs that grow considerably by it.

        Args:
            t: (N, H·W).
            rounds: largest number of iterations.
        """
        growing = [k for k, area in enumerate(self.area) if area >= _LARGE_PX]
        if not growing:
            return
        paint = (t > _UNLABELLED_PAINT).view(np.uint8).reshape(self.shape) & self._known
        for _ in range(rounds):
            growing = [k for k in growing if self._grow(k, paint[k])]
            if not growing:
                break
            self._update_neighbourhoods(growing)

    def _grow(self, k: int, paint: ImageArray) -> bool:
        """Add adjacent paint (H, W) to the mask of a blob if it grows considerably; return whether it did."""
        # Smallest growth of a mask; only blobs with motion blur or shadow grow more. Otherwise the mask is
        # not changed.
        much = 1.15 * self.area[k]
        if cv2.countNonZero(paint | self._inside[k]) < much:
            return False
        # Within three pixels of the blob, further than the rim extends.
        about = np.asarray(cv2.dilate(self._near[k], _CROSS), dtype=np.uint8)
        grown = paint & about | self._inside[k]
        if cv2.countNonZero(grown) < much:
            return False
        self._inside[k] = grown
        return True

    def products(self, t: CoverageArray) -> tuple[CoverageArray, CoverageArray]:
        """Return the sums for `rhot_capture.detection.subpixel.windows.fitted_levels`.

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
        """Return the unclipped painted share of every pixel, (N, H·W).

        Args:
            t: (N, H·W).
            planes: (2·N, 3), coefficients of 1, x, y: N levels outside, then N inside.
        """
        found = np.array(planes, np.float32) @ self.monomials[:3]
        outside, step = found[: len(t)], found[len(t) :]
        step -= outside
        np.maximum(step, MIN_STEP, out=step)
        share: CoverageArray = t - outside
        share /= step
        return share

    def clip(self, share: CoverageArray) -> None:
        """Clip shares (N, H·W) in place, and set them to 0 in the surroundings and to 1 in pure paint."""
        share.clip(LEAST, MOST, out=share)
        share *= self._rim
        share += self._pure

    def totals(self, share: CoverageArray) -> list[tuple[float, Sums]]:
        """Return per window the sum of shares, and the sums of 1, x, y weighted by the shares with gain.

        Args:
            share: (N, H·W).
        """
        counted = share * self._gain
        np.minimum(counted, self._most, out=counted)
        sums = cast(list[Sums], (counted @ self.monomials[:3].T).tolist())
        return list(zip((share @ self.monomials[0]).tolist(), sums, strict=True))


def skin_ring(mask: ImageArray) -> ImageArray:
    """Return the ring around a mask (H, W), 0 or 1, in which skin is looked for: 2.5 to 4.5 pixels outside."""
    near = np.asarray(cv2.dilate(mask, _WITHIN_2_5), dtype=np.uint8)
    return np.asarray(cv2.dilate(near, _TWO_STEPS), dtype=np.uint8) ^ near


def _eroded(mask: ImageArray, kernel: ImageArray) -> ImageArray:
    """Return the eroded mask; pixels outside the image count as outside the mask."""
    return np.asarray(cv2.erode(mask, kernel, borderType=cv2.BORDER_CONSTANT, borderValue=0), dtype=np.uint8)


@lru_cache(maxsize=256)
def _gains(round_parts: tuple[bool, ...]) -> tuple[CoverageArray, CoverageArray]:
    """Return the gain (N, 1) of shares, and the upper bound (N, 1) of the product."""
    gains = [(ROUND_GAIN, 1.0) if is_round else (1.0, float(MOST)) for is_round in round_parts]
    gain, most = np.array(gains, np.float32).T[:, :, None]
    return gain, most


@lru_cache(maxsize=256)
def _monomials(height: int, width: int) -> CoverageArray:
    """Return 1, x, y, x², xy, y² of a window's pixels, relative to its middle, (6, height · width)."""
    y, x = np.indices((height, width), np.float32).reshape(2, -1)
    x, y = x - np.float32(0.5 * (width - 1)), y - np.float32(0.5 * (height - 1))
    monomials = np.array([np.ones_like(x), x, y, x * x, x * y, y * y])
    monomials.setflags(write=False)
    return monomials
