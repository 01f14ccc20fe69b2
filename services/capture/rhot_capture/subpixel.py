"""Sub-pixel centres of blobs from how much of each rim pixel is paint.

A pixel at the rim mixes paint with what lies beside it, which may be black cloth here, bright skin there and a mixture
of these where they meet. With P the mean of the pure paint inside, μ and Σ mean and covariance of the colours around
the blob, the projection t = n·(c − μ) with n = (Σ + σ²I)⁻¹·(P − μ) is blind to the directions in which the
surroundings vary (the matched filter of spectral unmixing). Between its local levels outside (t₀) and inside (t₁),
α = (t − t₀)/(t₁ − t₀) is the painted share of a pixel. The centre is the centroid of α; blur spreads α evenly to both
sides of the rim and leaves its centroid.

Paint in shadow, in a highlight or smeared by motion may have been labelled as nobody's; beside a large blob it is taken
back by t, which tells paint from the surroundings better than the label does. Only a large blob has enough pure paint
for levels of its lit and of its shaded side; a small one has one level.

All blobs of a frame are laid one below the other on a strip, so that each step is one call for all of them.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import cv2
import numpy as np
from numpy.typing import NDArray

from rhot_capture.color_table import ImageArray

CoverageArray = NDArray[np.float32]
FloatArray = NDArray[np.float64]

_RIM_OUTSIDE_PX: Final = 3
_RIM_INSIDE_PX: Final = 2
_REACH_PX: Final = 5
"""Half width of the window that looks for pure paint or surroundings; wider than the rim on both sides."""
_GAP_PX: Final = _REACH_PX + 2
"""Between two blobs on the strip: none may look into the other's window."""
_LARGE_PX: Final = 64
"""From this many pixels on a blob has levels per side; measured: below, their noise costs more than shading does."""
_LOCAL_PX: Final = 1.7
"""σ of the weights of pure paint and surroundings by distance, for large blobs."""
_NOISE: Final = 5.0
"""σ, grey levels: variation of the surroundings that is no reason to avoid a direction."""
_MIN_CONTRAST: Final = 12.0
"""Grey levels between paint and surroundings below which their mixture cannot be told."""
_MIN_SURROUNDINGS: Final = 8
_MIN_CORE_SHARE: Final = 0.08
_TAKEN_BACK: Final = 0.4
"""t from which an unlabelled pixel beside a large blob is paint: the darkest shadow that is still told from a rim."""
_GROWN_MUCH: Final = 1.25
_ROUNDS: Final = 2
_MIN_STEP: Final = 0.2
ROUND_GAIN: Final = 1.4
_OVERSHOOT: Final = 0.25
"""Noise may push a share this far below 0 or above 1; clipping tighter would favour one side of the rim."""

_ALONE: Final = cv2.BORDER_CONSTANT | cv2.BORDER_ISOLATED
_DISC_INSIDE: Final = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * _RIM_INSIDE_PX + 1, 2 * _RIM_INSIDE_PX + 1))
_DISC_OUTSIDE: Final = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * _RIM_OUTSIDE_PX + 1, 2 * _RIM_OUTSIDE_PX + 1))
_CROSS: Final = cv2.getStructuringElement(cv2.MORPH_CROSS, (3, 3))


@dataclass(frozen=True, slots=True)
class Window:
    """A blob's window of the image.

    Attributes:
        image: (h, w, 3) uint8.
        mask: (h, w) uint8, 255 where the pixels were taken for the marker, holes filled.
        round_part: whether the paint covers something round, such as a fingertip.
    """

    image: ImageArray
    mask: ImageArray
    round_part: bool = False


@dataclass(frozen=True, slots=True)
class Centre:
    """Centre of a blob.

    Attributes:
        u, v: pixels, in the coordinates of the window.
        area: painted area, square pixels.
        share: (h, w) float32, painted share of every pixel, 0 to 1 up to noise; exactly 0 and 1 away from the rim.
    """

    u: float
    v: float
    area: float
    share: CoverageArray


def find_centres(windows: Sequence[Window]) -> list[Centre]:
    """Return the centres of blobs, in their order.

    Round parts are darker towards their edge, so that paint there looks like a mixture with a dark background and
    would count for less on the shaded side. Counting a share of 1 / `ROUND_GAIN` and more as full takes most of that
    back; it moves the rim outwards by the same small amount on all sides.
    """
    if not windows:
        return []
    order = sorted(range(len(windows)), key=lambda place: cv2.countNonZero(windows[place].mask))
    centres = dict(zip(order, _centres([windows[place] for place in order]), strict=True))
    return [centres[place] for place in range(len(windows))]


class _Strip:
    """Windows one below the other, from small to large blobs.

    Attributes:
        windows: the windows.
        rows: rows of each window on the strip; its columns start at 0.
        large_from: row from which on the windows of large blobs lie.
        mask: (H, W) uint8, 255 inside the blobs.
        reach: (H, W) uint8, 255 where there may be paint.
        outside: (H, W) uint8, 255 in the surroundings, which hold no paint.
        core: (H, W) uint8, 255 where the paint is surely pure; the whole blob where it is too small for rim and core.
        pure: per window whether its core is not the whole blob.
        pixels: (H, W, 4) float32, the colours and a 1.
    """

    def __init__(self, windows: Sequence[Window]) -> None:
        self.windows = windows
        self.rows: list[slice] = []
        top = 0
        for window in windows:
            self.rows.append(slice(top, top + window.mask.shape[0]))
            top += window.mask.shape[0] + _GAP_PX
        large = [cv2.countNonZero(window.mask) >= _LARGE_PX for window in windows]
        self.large_from = self.rows[large.index(True)].start if any(large) else top
        shape = (top - _GAP_PX, max(window.mask.shape[1] for window in windows))
        self.mask: ImageArray = np.zeros(shape, np.uint8)
        self._known: ImageArray = np.zeros(shape, np.uint8)
        self.pixels: CoverageArray = np.ones((*shape, 4), np.float32)
        for window, rows in zip(windows, self.rows, strict=True):
            width = window.mask.shape[1]
            self.mask[rows, :width] = window.mask
            self._known[rows, :width] = 255
            self.pixels[rows, :width, :3] = window.image
        self.look_around()

    def look_around(self) -> None:
        """Find core and surroundings of the blobs as their masks are now."""
        self.reach: ImageArray = np.asarray(cv2.dilate(self.mask, _DISC_OUTSIDE), dtype=np.uint8)
        self.outside: ImageArray = np.asarray(cv2.subtract(self._known, self.reach), dtype=np.uint8)
        self.core: ImageArray = np.asarray(cv2.erode(self.mask, _DISC_INSIDE), dtype=np.uint8)
        narrow: ImageArray | None = None
        self.pure = [True] * len(self.rows)
        for place, rows in enumerate(self.rows):
            least = _MIN_CORE_SHARE * cv2.countNonZero(self.mask[rows])
            if cv2.countNonZero(self.core[rows]) <= least:
                narrow = np.asarray(cv2.erode(self.mask, _CROSS), dtype=np.uint8) if narrow is None else narrow
                self.pure[place] = cv2.countNonZero(narrow[rows]) > least
                self.core[rows] = (narrow if self.pure[place] else self.mask)[rows]


def _centres(windows: Sequence[Window]) -> list[Centre]:
    strip = _Strip(windows)
    projected, usable = _projection(strip)
    if strip.large_from < len(strip.mask):
        large = slice(strip.large_from, None)
        for _ in range(_ROUNDS):
            before = cv2.countNonZero(strip.mask[large])
            strip.mask[large][(projected[large] > _TAKEN_BACK) & (strip.reach[large] > 0)] = 255
            strip.look_around()
            # Only what motion smears or shade hides grows by much; its edge is not reached in one step.
            if cv2.countNonZero(strip.mask[large]) < _GROWN_MUCH * before:
                break
    # t is 0 in the mean of the surroundings and 1 in the mean of the paint; shading shifts both locally.
    inside_level = _local_mean(projected, strip.core, 1.0, strip.large_from)
    outside_level = _local_mean(projected, strip.outside, 0.0, strip.large_from)
    share = (projected - outside_level) / np.maximum(inside_level - outside_level, _MIN_STEP)
    np.maximum(share, -_OVERSHOOT, out=share)
    np.minimum(share, 1.0 + _OVERSHOOT, out=share)
    # Beyond the reach and between the windows there is no paint.
    share *= strip.reach > 0
    for place, rows in enumerate(strip.rows):
        if not usable[place]:
            share[rows] = 0.0
            share[rows, : windows[place].mask.shape[1]] = windows[place].mask > 0
        elif strip.pure[place]:
            share[rows][strip.core[rows] > 0] = 1.0
    return _centroids(strip, share)


def _projection(strip: _Strip) -> tuple[CoverageArray, NDArray[np.bool_]]:
    """Return t for every pixel of a strip, and per window whether paint and surroundings can be told apart."""
    count = len(strip.rows)
    moments = np.empty((count, 4, 4))
    core = np.empty((count, 4))
    around = strip.pixels * (strip.outside > 0)[..., None]
    weights = (strip.core > 0).astype(np.float32)
    for place, rows in enumerate(strip.rows):
        flat = around[rows].reshape(-1, 4)
        moments[place] = flat.T @ flat
        core[place] = weights[rows].reshape(-1) @ strip.pixels[rows].reshape(-1, 4)
    total = np.maximum(moments[:, 3, 3], 1.0)[:, None]
    mean = moments[:, 3, :3] / total
    paint = core[:, :3] / core[:, 3:] - mean
    spread = moments[:, :3, :3] / total[..., None] - mean[:, :, None] * mean[:, None, :] + _NOISE**2 * np.eye(3)
    direction = np.linalg.solve(spread, paint[..., None])[..., 0]
    direction /= np.maximum(np.sum(direction * paint, axis=1, keepdims=True), 1e-9)
    usable = (moments[:, 3, 3] >= _MIN_SURROUNDINGS) & (np.sum(paint**2, axis=1) >= _MIN_CONTRAST**2)
    line = np.concatenate([direction, -np.sum(direction * mean, axis=1, keepdims=True)], axis=1).astype(np.float32)
    projected: CoverageArray = np.zeros(strip.mask.shape, np.float32)
    for place, rows in enumerate(strip.rows):
        np.dot(strip.pixels[rows].reshape(-1, 4), line[place], out=projected[rows].reshape(-1))
    return projected, usable


def _local_mean(values: CoverageArray, source: ImageArray, default: float, large_from: int) -> CoverageArray:
    """Return the mean of nearby source pixels at every pixel; `default` where there are none.

    Args:
        values: (H, W) to average.
        source: (H, W) uint8, 255 where a value counts.
        default: where none is in reach.
        large_from: row from which on nearer pixels count for more.
    """
    weights = (source > 0).astype(np.float32)
    total = values * weights
    size = (2 * _REACH_PX + 1, 2 * _REACH_PX + 1)
    for array in (weights, total):
        if large_from > 0:
            array[:large_from] = cv2.blur(array[:large_from], size, borderType=_ALONE)
        if large_from < len(array):
            array[large_from:] = cv2.GaussianBlur(array[large_from:], size, _LOCAL_PX, borderType=_ALONE)
    # The running total of a box may be some 1e-8 off zero.
    level: CoverageArray = np.full(values.shape, default, np.float32)
    np.divide(total, weights, out=level, where=weights > 1e-6)
    return level


def _centroids(strip: _Strip, share: CoverageArray) -> list[Centre]:
    height, width = share.shape
    gain: CoverageArray = np.ones((height, 1), np.float32)
    limit: CoverageArray = np.full((height, 1), 1.0 + _OVERSHOOT, np.float32)
    for window, rows in zip(strip.windows, strip.rows, strict=True):
        if window.round_part:
            gain[rows], limit[rows] = ROUND_GAIN, 1.0
    weights = np.minimum(share * gain, limit)
    across = np.ones((width, 2), np.float32)
    across[:, 1] = np.arange(width)
    # Sums over the columns of each row, then over the rows of each window; gaps hold nothing.
    sums = np.concatenate([weights @ across, share @ across[:, :1]], axis=1).astype(np.float64)
    by_row = sums[:, :1] * np.arange(height, dtype=np.float64)[:, None]
    starts = [rows.start for rows in strip.rows]
    return [
        Centre(m10 / m00, m01 / m00 - start, area, share[rows, : window.mask.shape[1]])
        for window, rows, start, (m00, m10, area, m01) in zip(
            strip.windows,
            strip.rows,
            starts,
            np.add.reduceat(np.concatenate([sums, by_row], axis=1), starts, axis=0).tolist(),
            strict=True,
        )
    ]
