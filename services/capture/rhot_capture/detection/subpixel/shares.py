"""Painted shares of a window's pixels: relative to local levels, and interpolated between pixels."""

from __future__ import annotations

from typing import Final, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

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
        t: (H·W,), see `rhot_capture.detection.subpixel.centers`.
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
