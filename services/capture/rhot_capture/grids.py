"""Windows of blobs on one array: which pixels are rim, pure paint and surroundings, and the sums over them.

As shares are linear in colour, the mean of four pixels has their mean share: a large window is measured on a coarser
grid, at the cost of a small one.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Final

import cv2
import numpy as np
from numpy.typing import NDArray

from rhot_capture.color_table import ImageArray

CoverageArray = NDArray[np.float32]
FloatArray = NDArray[np.float64]
BoolArray = NDArray[np.bool_]

_COARSE_FROM_PX: Final = 40
"""Width or height from which on a window is measured on a grid twice as coarse; coarser still, hardly any of the
surroundings would be left beyond the rim."""
_MARGIN_PX: Final = 2
"""Round each window, so that none is within reach of the next one's blob."""
_OUTSIDE_PX: Final = 2.5
"""Distance from the blob, pixel centre to pixel centre, from which on there is no paint."""
_TAKEN_BACK_PX: Final = 3.0
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
_TAKEN_BACK: Final = 0.4
"""t from which an unlabelled pixel beside a large blob is paint: the darkest shadow that is still told from a rim."""
_GROWN_MUCH: Final = 1.15
"""Only what motion smears or shade hides would grow by more, by what is taken back; else the mask is left as it is."""
_LOCAL_PX: Final = 1.7
"""σ of the weights of pure paint and surroundings by distance, for local means."""
_LOCAL_SIZE: Final = (11, 11)
_MIN_STEP: Final = 0.2
ROUND_GAIN: Final = 1.4
_MIN_SHARE_OF_MASK: Final = 0.5
"""With less paint than that, or a centre outside of the window, the shares are nonsense, and the mask counts."""
_OVERSHOOT: Final = 0.25
"""Noise may push a share this far below 0 or above 1; clipping tighter would favour one side of the rim."""


@dataclass(frozen=True, slots=True)
class Window:
    """A blob's window of the image.

    Attributes:
        image: (h, w, 3) uint8.
        mask: (h, w) uint8, 255 where the pixels were taken for the marker, holes filled.
        round_part: whether the paint covers something round, such as a fingertip.
        shared: whether the share of every pixel is asked for.
    """

    image: ImageArray
    mask: ImageArray
    round_part: bool = False
    shared: bool = True


@dataclass(frozen=True, slots=True)
class Centre:
    """Centre of a blob.

    Attributes:
        u, v: pixels, in the coordinates of the window.
        area: painted area, square pixels.
        share: (h, w) float32, painted share of every pixel, 0 to 1 up to noise, exactly 0 away from the blob; None
            where it was not asked for.
    """

    u: float
    v: float
    area: float
    share: CoverageArray | None


class Grid:
    """A window as it is measured.

    Attributes:
        window: as it was given.
        scale: pixels of the window to the side of one of the grid.
        left, top: of the grid in the window, pixels.
        image: (h, w, 3) uint8, mean colours.
        mask: (h, w) uint8, not 0 where at least half is inside the blob.
        rows, columns: place in the array of the batch.
    """

    def __init__(self, window: Window, coarse: bool = True) -> None:
        self.window = window
        self.image, self.mask = window.image, window.mask
        height, width = self.mask.shape
        self.scale = 2 if coarse and max(height, width) >= _COARSE_FROM_PX else 1
        self.left = self.top = 0
        if self.scale > 1:
            # What is left over goes on a side where there is no paint.
            over_y, over_x = height % self.scale, width % self.scale
            self.top = over_y if over_y and self.mask[-over_y:].any() else 0
            self.left = over_x if over_x and self.mask[:, -over_x:].any() else 0
            height, width = height // self.scale, width // self.scale
            part = (
                slice(self.top, self.top + height * self.scale),
                slice(self.left, self.left + width * self.scale),
            )
            self.image = np.asarray(
                cv2.resize(self.image[part], (width, height), interpolation=cv2.INTER_AREA), dtype=np.uint8
            )
            covered = cv2.resize(self.mask[part], (width, height), interpolation=cv2.INTER_AREA)
            # What fills no pixel of the grid by half, lone pixels in a large window, is kept where it fills most.
            self.mask = (covered > min(127, int(covered.max()) - 1)).view(np.uint8)
        self.rows = slice(_MARGIN_PX, _MARGIN_PX + height)
        self.columns = slice(_MARGIN_PX, _MARGIN_PX + width)


class Batch:
    """Grids of about one size in one array; H and W leave a margin round the largest.

    Attributes:
        grids: the grids.
        mask: (N, H, W) uint8, 1 inside the blobs.
        known: (N, H, W) bool, where there is a picture.
        features: (N, 6, H·W) float32: blue, green, red, 1, x, y from the middle.
        distance: (N, H, W) float32, to the blob.
        reach: (N, H, W) bool, where there may be paint.
        core: (N, H, W) bool, where the paint is surely pure; the whole blob where it is too small for rim and core.
        pure: (N,) whether the core is not the whole blob.
        area: (N,) pixels inside the blobs.
        weights: (N, 2, H·W) float32, 1 in the surroundings, which hold no paint, and in the core.
    """

    def __init__(self, grids: Sequence[Grid]) -> None:
        self.grids = grids
        count = len(grids)
        height = max([grid.rows.stop for grid in grids]) + _MARGIN_PX
        width = max([grid.columns.stop for grid in grids]) + _MARGIN_PX
        shape = (count, height, width)
        self.mask: ImageArray = np.zeros(shape, np.uint8)
        self.known: BoolArray = np.zeros(shape, np.bool_)
        self.features: CoverageArray = np.zeros((count, 6, height * width), np.float32)
        self.features[:, 3:] = _places(height, width)
        colours = self.features.reshape(count, 6, height, width)
        for place, grid in enumerate(grids):
            self.mask[place, grid.rows, grid.columns] = grid.mask
            self.known[place, grid.rows, grid.columns] = True
            colours[place, :3, grid.rows, grid.columns] = grid.image.transpose(2, 0, 1)
        self.mask &= 1
        self.weights: CoverageArray = np.empty((count, 2, height * width), np.float32)
        self._limits, self._gain, self._most = _rules(tuple([(grid.scale, grid.window.round_part) for grid in grids]))
        self.look_around()

    def look_around(self) -> None:
        """Find core and surroundings of the blobs as their masks are now."""
        count, height, width = shape = self.mask.shape
        strip = self.mask.reshape(count * height, width)
        inside = cv2.distanceTransform(strip, cv2.DIST_L2, 3).reshape(shape)
        distance = cv2.distanceTransform(strip ^ 1, cv2.DIST_L2, 3)
        self.distance: CoverageArray = np.asarray(distance, dtype=np.float32).reshape(shape)
        self.reach: BoolArray = (self.distance < self._limits[0]) & self.known
        self.core: BoolArray = inside > self._limits[1]
        self.area = [cv2.countNonZero(mask) for mask in self.mask]
        self.pure = [True] * count
        for place, area in enumerate(self.area):
            least = _MIN_CORE_SHARE * area
            # A blob large enough has a core that is.
            if area < _LARGE_PX and np.count_nonzero(self.core[place]) <= least:
                narrow = inside[place] > _NARROW_PX
                self.pure[place] = bool(np.count_nonzero(narrow) > least)
                self.core[place] = narrow if self.pure[place] else self.mask[place]
        self.weights[:, 0] = (self.known ^ self.reach).reshape(count, -1)
        self.weights[:, 1] = self.core.reshape(count, -1)

    def moments(self) -> FloatArray:
        """Return the sums of products of the features in the surroundings and in the core, (N, 2, 6, 6)."""
        count, features, size = self.features.shape
        weighted = (self.features[:, None] * self.weights[:, :, None]).reshape(count, 2 * features, size)
        return (weighted @ self.features.transpose(0, 2, 1)).reshape(count, 2, features, features).astype(np.float64)

    def take_back(self, line: FloatArray) -> bool:
        """Add to the masks of large blobs what t tells to be paint beside them; return whether any has grown much.

        Args:
            line: (N, 4), t of blue, green, red, 1.
        """
        if max(self.area) < _LARGE_PX:
            return False
        projected = line.astype(np.float32)[:, None] @ self.features[:, :4]
        taken = projected.reshape(self.mask.shape) > _TAKEN_BACK
        taken &= self.distance < _TAKEN_BACK_PX
        taken &= self.known
        taken |= self.mask.view(np.bool_)
        has_grown = False
        for place, area in enumerate(self.area):
            if area >= _LARGE_PX and np.count_nonzero(taken[place]) >= _GROWN_MUCH * area:
                self.mask[place] = taken[place]
                has_grown = True
        if has_grown:
            self.look_around()
        return has_grown

    def shares(self, parts: FloatArray) -> CoverageArray:
        """Return the painted share of every pixel, (N, H, W).

        Args:
            parts: (N, 2, 6), numerator and denominator of α as functions of the features.
        """
        found = parts.astype(np.float32) @ self.features
        np.maximum(found[:, 1], _MIN_STEP, out=found[:, 1])
        share: CoverageArray = np.divide(found[:, 0], found[:, 1]).reshape(self.mask.shape)
        return share

    def local_share(self, place: int, line: FloatArray) -> CoverageArray:
        """Return the painted share of one window's pixels between local levels of paint and surroundings, (H, W).

        Args:
            place: of the window.
            line: (4,), t of blue, green, red, 1.
        """
        shape = self.mask.shape[1:]
        projected: CoverageArray = (line.astype(np.float32) @ self.features[place, :4]).reshape(shape)
        levels = []
        for weights, default in zip(self.weights[place].reshape(2, *shape), (0.0, 1.0), strict=True):
            near, total = (
                cv2.GaussianBlur(values, _LOCAL_SIZE, _LOCAL_PX, borderType=cv2.BORDER_CONSTANT)
                for values in (weights, weights * projected)
            )
            level: CoverageArray = np.full(shape, default, np.float32)
            np.divide(total, near, out=level, where=near > 1e-6)
            levels.append(level)
        outside, inside = levels
        share: CoverageArray = (projected - outside) / np.maximum(inside - outside, np.float32(_MIN_STEP))
        return share

    def centroids(self, share: CoverageArray, parts: FloatArray) -> list[Centre]:
        """Return the centres of the windows.

        Args:
            share: (N, H, W), painted share of every pixel as it came out; is tidied here.
            parts: (N, 2, 6), as it was found with, in case it is wanted on a finer grid.
        """
        _, height, width = share.shape
        # Beyond the reach and between the windows there is no paint.
        np.minimum(share, 1.0 + _OVERSHOOT, out=share)
        np.maximum(share, -_OVERSHOOT, out=share)
        share *= self.reach
        np.copyto(share, 1.0, where=self.core & np.array(self.pure)[:, None, None])
        sums = self._sums(share)
        doubtful = [
            place
            for place, ((area, _, _), (m00, m10, m01)) in enumerate(sums)
            if area < _MIN_SHARE_OF_MASK * self.area[place]
            or abs(m10) > 0.5 * width * m00
            or abs(m01) > 0.5 * height * m00
        ]
        if doubtful:
            share[doubtful] = self.mask[doubtful]
            sums = self._sums(share)
        middle_u, middle_v = 0.5 * width - _MARGIN_PX, 0.5 * height - _MARGIN_PX
        centres = []
        for place, (grid, ((area, _, _), (m00, m10, m01))) in enumerate(zip(self.grids, sums, strict=True)):
            scale = grid.scale
            own = None
            if grid.window.shared:
                own = share[place, grid.rows, grid.columns] if scale == 1 else self._fine(place, share[place], parts)
            u = grid.left + scale * (m10 / m00 + middle_u) - 0.5
            v = grid.top + scale * (m01 / m00 + middle_v) - 0.5
            centres.append(Centre(u, v, area * scale**2, own))
        return centres

    def _sums(self, share: CoverageArray) -> list[tuple[tuple[float, float, float], tuple[float, float, float]]]:
        """Return per window the sums of 1, x, y, by share and by what counts of a share for the centre."""
        count, height, width = share.shape
        counted = np.empty((count, 2, height * width), np.float32)
        counted[:, 0] = share.reshape(count, -1)
        np.multiply(counted[:, 0], self._gain, out=counted[:, 1])
        np.minimum(counted[:, 1], self._most, out=counted[:, 1])
        sums: list[tuple[tuple[float, float, float], tuple[float, float, float]]] = (
            counted @ self.features[:, 3:].transpose(0, 2, 1)
        ).tolist()
        return sums

    def _fine(self, place: int, share: CoverageArray, parts: FloatArray) -> CoverageArray:
        """Return the painted share of every pixel of a window that was measured on a coarser grid.

        Args:
            place: of the grid.
            share: (H, W) on the grid.
            parts: (N, 2, 6), as it was found with.
        """
        grid = self.grids[place]
        scale = grid.scale
        height, width = grid.window.mask.shape
        x = (np.arange(width) - grid.left + 0.5) / scale + _MARGIN_PX - 0.5 * share.shape[1]
        y = (np.arange(height) - grid.top + 0.5) / scale + _MARGIN_PX - 0.5 * share.shape[0]
        numerator, denominator = parts[place]
        fine: CoverageArray = np.asarray(
            cv2.transform(grid.window.image.astype(np.float32), numerator[None, :3]), dtype=np.float32
        )
        fine += ((numerator[3] + numerator[4] * x) + (numerator[5] * y)[:, None]).astype(np.float32)
        level = ((denominator[3] + denominator[4] * x) + (denominator[5] * y)[:, None]).astype(np.float32)
        fine /= np.maximum(level, np.float32(_MIN_STEP))
        np.minimum(fine, 1.0 + _OVERSHOOT, out=fine)
        np.maximum(fine, -_OVERSHOOT, out=fine)
        # Beyond the reach there is no paint, as on the grid.
        shown = share[grid.rows, grid.columns]
        coarse = np.zeros((height, width), np.float32)
        covered = coarse[grid.top : grid.top + scale * shown.shape[0], grid.left : grid.left + scale * shown.shape[1]]
        cv2.resize(shown, covered.shape[::-1], dst=covered, interpolation=cv2.INTER_NEAREST)
        fine[coarse == 0.0] = 0.0
        return fine


@lru_cache(maxsize=256)
def _rules(kinds: tuple[tuple[int, bool], ...]) -> tuple[CoverageArray, CoverageArray, CoverageArray]:
    """Return what depends on the scale of grids and on whether parts are round.

    Returns:
        (2, N, 1, 1) distances outside and inside of the rim; (N, 1) gain of a share, and the most that one counts for.
    """
    distances = [(_OUTSIDE_PX, _INSIDE_PX) if scale == 1 else (_COARSE_OUTSIDE, _COARSE_INSIDE) for scale, _ in kinds]
    gains = [(ROUND_GAIN, 1.0) if is_round else (1.0, 1.0 + _OVERSHOOT) for _, is_round in kinds]
    gain, most = np.array(gains, np.float32).T[:, :, None]
    return np.array(distances, np.float32).T[:, :, None, None], gain, most


@lru_cache(maxsize=256)
def _places(height: int, width: int) -> CoverageArray:
    """Return 1, x and y of the pixels of a window, counted from its middle, (3, height · width)."""
    places = np.ones((3, height, width), np.float32)
    places[1] = np.arange(width) - 0.5 * (width - 1)
    places[2] = (np.arange(height) - 0.5 * (height - 1))[:, None]
    places.setflags(write=False)
    return places.reshape(3, height * width)
