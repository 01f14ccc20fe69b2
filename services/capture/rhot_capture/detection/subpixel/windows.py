"""Windows of the image that contain a blob each, and the grids on which they are measured.

Painted shares are linear in colour, so the mean of four pixels has their mean share. Large windows are therefore
measured on a coarser grid, which saves time.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final, NamedTuple, cast

import cv2
import numpy as np
from numpy.typing import NDArray

from rhot.arrays import ImageArray
from rhot.types import Vector3

# Spectral unmixing of paint and surroundings: the algebra of `subpixel.centers`, on sums over pixels.
#
# Uses plain floats: for a few 3x3 systems numpy's call overhead dominates. This must save at least a tenth of a frame's
# time to be worth keeping; `rhot bench --part capture` measures it.

Line = tuple[float, float, float, float]

# How these were chosen is not recorded; tests/capture/test_simulated_accuracy.py limits the resulting error.
NOISE: Final = 5.0
"""σ of the camera noise, grey levels: regularises the covariance of the surroundings."""
MIN_CONTRAST: Final = 12.0
"""Smallest usable difference between paint and surroundings, grey levels; 2.4 times `NOISE`."""
MIN_SURROUNDINGS: Final = 8
"""Smallest number of pixels for a mean and a covariance, which have nine parameters."""
RIDGE: Final = 30.0
"""Regularisation of the slopes of a level, square pixels: limits noise where there are few pixels."""
TINY: Final = 1e-6
"""Regularisation of the mean, pixels: keeps the matrix invertible where there are none."""
MISFIT: Final = 1.6
"""Deviation of pure paint from its plane, in units of the noise, above which local means replace the planes."""


def projections(sums: CoverageArray) -> tuple[list[Line], list[bool]]:
    """Return the coefficients of t for blue, green, red, 1, and whether paint and surroundings are distinguishable.

    Args:
        sums: (N, 5, 4) sums of blue, green, red, 1: over the surroundings; over the pure paint; over the surroundings
            times blue, green and red.
    """
    found = [_projection(*each) for each in cast(list[list[list[float]]], sums.tolist())]
    return [line for line, _ in found], [usable for _, usable in found]


def _projection(
    outside: Sequence[float],
    inside: Sequence[float],
    blue: Sequence[float],
    green: Sequence[float],
    red: Sequence[float],
) -> tuple[Line, bool]:
    b, g, r, total = outside
    share = 1.0 / max(total, 1.0)
    b, g, r = b * share, g * share, r * share
    paint_share = 1.0 / max(inside[3], 1.0)
    x, y, z = inside[0] * paint_share - b, inside[1] * paint_share - g, inside[2] * paint_share - r
    bb, bg, br, _ = blue
    gg, gr, rr = green[1], green[2], red[2]
    u, v, w = _solved(
        (bb * share - b * b + NOISE**2, bg * share - b * g, br * share - b * r),
        (gg * share - g * g + NOISE**2, gr * share - g * r, rr * share - r * r + NOISE**2),
        (x, y, z),
    )
    scale = 1.0 / max(u * x + v * y + w * z, 1e-9)
    u, v, w = u * scale, v * scale, w * scale
    usable = total >= MIN_SURROUNDINGS and x * x + y * y + z * z >= MIN_CONTRAST**2
    return (u, v, w, -(u * b + v * g + w * r)), usable


def fitted_levels(
    lines: Sequence[Line], moments: CoverageArray, products: CoverageArray, squares: CoverageArray
) -> tuple[list[Vector3], list[bool]]:
    """Return the least squares planes of t, and whether those of the pure paint fit badly.

    Args:
        lines: N times the coefficients of t for blue, green, red, 1.
        moments: (N, 2, 6) sums of 1, x, y, x², xy, y² over the surroundings and over the pure paint.
        products: (N, 2, 3) sums of the products of t with 1, x, y over both.
        squares: (N,) sum of t² over the pure paint.

    Returns:
        2·N coefficients of 1, x, y: the planes of the surroundings, then those of the pure paint; N misfits.
    """
    outside, inside, misfits = [], [], []
    for line, (around, core), (t_around, t_core), square in zip(
        lines, moments.tolist(), products.tolist(), squares.tolist(), strict=True
    ):
        outside.append(_plane(around, t_around))
        inside.append(_plane(core, t_core))
        # Residual sum of squares of the pure paint's t, compared with that of noise alone.
        level, slope_x, slope_y = inside[-1]
        t, tx, ty = t_core
        u, v, w, _ = line
        noise = (MISFIT * NOISE) ** 2 * (u * u + v * v + w * w) * core[0]
        misfits.append(square - level * t - slope_x * tx - slope_y * ty > noise)
    return outside + inside, misfits


def _plane(sums: Sequence[float], products: Sequence[float]) -> Vector3:
    n, x, y, xx, xy, yy = sums
    return _solved((n + TINY, x, y), (xx + RIDGE, xy, yy + RIDGE), products)


def _solved(first: Vector3, rest: Vector3, right: Sequence[float]) -> Vector3:
    """Return the solution of a symmetric 3x3 system.

    Args:
        first: first row of the positive definite matrix.
        rest: its entries (2, 2), (2, 3) and (3, 3).
        right: right-hand side.
    """
    a, b, c = first
    d, e, f = rest
    x, y, z = right
    aa, ab, ac = d * f - e * e, c * e - b * f, b * e - c * d
    bb, bc, cc = a * f - c * c, b * c - a * e, a * d - b * b
    scale = 1.0 / (a * aa + b * ab + c * ac)
    return (
        (aa * x + ab * y + ac * z) * scale,
        (ab * x + bb * y + bc * z) * scale,
        (ac * x + bc * y + cc * z) * scale,
    )


# Painted shares of a window's pixels: relative to local levels, and interpolated between pixels.

CoverageArray = NDArray[np.float32]

MIN_STEP: Final = np.float32(0.2)
"""Lower bound of the difference of t between the levels inside and outside; extrapolated planes can come closer."""
OVERSHOOT: Final = np.float32(0.25)
"""Shares are clipped this far below 0 and above 1; tighter clipping of noise would bias the centre."""
LEAST: Final = -OVERSHOOT
MOST: Final = np.float32(1.0) + OVERSHOOT


class Shares(NamedTuple):
    """Painted shares on a grid over a window.

    Attributes:
        share: (h, w) float32, 0 to 1 up to noise, exactly 0 away from the blob.
        scale: size of a grid cell, pixels of the window.
        left, top: position of the grid in the window, pixels.
    """

    share: CoverageArray
    scale: int
    left: int
    top: int

    def on_grid(self, position: tuple[float, float]) -> tuple[float, float]:
        """Return the grid coordinates of a position in the window, both x and y in pixels."""
        x, y = position
        half = 0.5 * (self.scale - 1)
        return (x - self.left - half) / self.scale, (y - self.top - half) / self.scale

    def at(self, positions: CoverageArray) -> CoverageArray:
        """Return the shares at positions, by bilinear interpolation; constant beyond the grid.

        The integral along a line across an edge is the same on a coarser grid, because averaging blurs symmetrically.

        Args:
            positions: (n, m, 2) float32, x and y in grid coordinates.

        Returns:
            (n, m) float32.
        """
        # OpenCV's type stubs lack the variant without a second map.
        found = cv2.remap(self.share, positions, None, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)  # type: ignore[call-overload]
        return np.asarray(found, dtype=np.float32)


def local_share(t: CoverageArray, weights: CoverageArray, shape: tuple[int, int]) -> CoverageArray:
    """Return the painted shares (H·W,) of a window relative to local means, where planes do not fit the levels.

    Args:
        t: (H·W,), see `rhot_capture.detection.subpixel.batch`.
        weights: (2, H·W), 1 in the surroundings, and 1 in the pure paint.
        shape: H and W.
    """
    levels = []
    for weight, default in zip(weights, (0.0, 1.0), strict=True):
        # Σ of the Gaussian weights of pure paint and surroundings, pixels; how it was chosen is not recorded.
        # Pixels, ± 3 σ.
        near, total = (
            cv2.GaussianBlur(values.reshape(shape), (11, 11), 1.7, borderType=cv2.BORDER_CONSTANT)
            for values in (weight, weight * t)
        )
        level: CoverageArray = np.full(shape, default, np.float32)
        np.divide(total, near, out=level, where=near > 1e-6)
        levels.append(level.reshape(-1))
    outside, inside = levels
    share: CoverageArray = (t - outside) / np.maximum(inside - outside, MIN_STEP)
    return share


class BlobWindow(NamedTuple):
    """A blob's window of the image.

    Attributes:
        image: (h, w, 3) uint8.
        mask: (h, w) uint8, 255 for pixels of the marker, holes filled.
        round_part: whether the painted surface is round, such as a fingertip.
        shared: whether to return the painted shares.
    """

    image: ImageArray
    mask: ImageArray
    round_part: bool = False
    shared: bool = True


class Centre(NamedTuple):
    """Centre of a blob.

    Attributes:
        u, v: pixels, in the coordinates of the window.
        area: painted area, square pixels.
        shares: painted shares of the window's pixels; None if they were not requested.
        skin_side: see `rhot.messages.Marker`; None without a table of skin.
        skin_share: share of the ring around the blob that is skin.
    """

    u: float
    v: float
    area: float
    shares: Shares | None
    skin_side: tuple[float, float] | None = None
    skin_share: float = 0.0


class Grid(NamedTuple):
    """Grid on which a window is measured.

    Attributes:
        window: the window.
        scale: size of a grid cell, pixels of the window.
        left, top: position of the grid in the window, pixels.
        image: (h, w, 3) uint8, mean colours.
        mask: (h, w) uint8, 255 where at least half is inside the blob, else 0.
    """

    window: BlobWindow
    scale: int
    left: int
    top: int
    image: ImageArray
    mask: ImageArray


def grid_of(window: BlobWindow, coarse: bool = True) -> Grid:
    """Return the grid of a window.

    Args:
        window: to be measured.
        coarse: whether a coarser grid may be used for a large window.
    """
    height, width = window.mask.shape
    # Width or height from which a window is measured on a grid that is twice as coarse. On a coarser one, hardly
    # any pixels of the surroundings would remain.
    if not coarse or max(height, width) < 40:
        return Grid(window, 1, 0, 0, window.image, window.mask)
    # An odd row or column is dropped on a side without paint.
    top = 1 if height % 2 and window.mask[-1].any() else 0
    left = 1 if width % 2 and window.mask[:, -1].any() else 0
    height, width = height // 2, width // 2
    part = slice(top, top + 2 * height), slice(left, left + 2 * width)
    image = cv2.resize(window.image[part], (width, height), interpolation=cv2.INTER_AREA)
    covered = cv2.resize(window.mask[part], (width, height), interpolation=cv2.INTER_AREA)
    _, mask = cv2.threshold(covered, 127, 255, cv2.THRESH_BINARY)
    if cv2.countNonZero(mask) == 0:
        # Isolated pixels that do not fill half of any cell: use the cells that they fill most.
        _, mask = cv2.threshold(covered, int(covered.max()) - 1, 255, cv2.THRESH_BINARY)
    return Grid(window, 2, left, top, np.asarray(image, dtype=np.uint8), np.asarray(mask, dtype=np.uint8))
