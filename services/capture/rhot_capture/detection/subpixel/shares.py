"""The painted share of a window's pixels: between local levels, and at positions between pixels."""

from __future__ import annotations

from typing import Final, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

CoverageArray = NDArray[np.float32]

MIN_STEP: Final = np.float32(0.2)
"""Of t, from the level outside to the level inside; where planes come nearer they are extrapolated too far."""
OVERSHOOT: Final = np.float32(0.25)
"""Noise may push a share this far below 0 or above 1; clipping tighter would favour one side of the rim."""
LEAST: Final = -OVERSHOOT
MOST: Final = np.float32(1.0) + OVERSHOOT


_LOCAL_PX: Final = 1.7
"""σ of the weights of pure paint and surroundings by distance, pixels; how it was chosen is not recorded."""
_LOCAL_SIZE: Final = (11, 11)
"""Pixels, ± 3 σ."""


class Shares(NamedTuple):
    """Painted shares on a grid over a window.

    Attributes:
        share: (h, w) float32, 0 to 1 up to noise, exactly 0 away from the blob.
        scale: pixels of the window to the side of one of the grid.
        left, top: of the grid in the window, pixels.
    """

    share: CoverageArray
    scale: int
    left: int
    top: int

    def on_grid(self, position: tuple[float, float]) -> tuple[float, float]:
        """Return where on the grid a position of the window is, both x and y in pixels."""
        x, y = position
        half = 0.5 * (self.scale - 1)
        return (x - self.left - half) / self.scale, (y - self.top - half) / self.scale

    def at(self, positions: CoverageArray) -> CoverageArray:
        """Return the shares at some positions; beyond the grid as at its border.

        A line across an edge has the same integral on a coarser grid: means blur it evenly to both sides.

        Args:
            positions: (n, m, 2) float32, x and y on the grid.

        Returns:
            (n, m) float32.
        """
        # With an empty second map, which OpenCV's stubs do not know.
        found = cv2.remap(self.share, positions, None, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)  # type: ignore[call-overload]
        return np.asarray(found, dtype=np.float32)


def local_share(t: CoverageArray, weights: CoverageArray, shape: tuple[int, int]) -> CoverageArray:
    """Return the painted share of a window's pixels between local means, where no plane describes the levels, (H·W,).

    Args:
        t: (H·W,), see `rhot_capture.detection.subpixel.centers`.
        weights: (2, H·W), 1 in the surroundings and in the pure paint.
        shape: H and W.
    """
    levels = []
    for weight, default in zip(weights, (0.0, 1.0), strict=True):
        near, total = (
            cv2.GaussianBlur(values.reshape(shape), _LOCAL_SIZE, _LOCAL_PX, borderType=cv2.BORDER_CONSTANT)
            for values in (weight, weight * t)
        )
        level: CoverageArray = np.full(shape, default, np.float32)
        np.divide(total, near, out=level, where=near > 1e-6)
        levels.append(level.reshape(-1))
    outside, inside = levels
    share: CoverageArray = (t - outside) / np.maximum(inside - outside, MIN_STEP)
    return share
