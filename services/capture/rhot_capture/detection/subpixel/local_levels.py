"""The painted share of pixels between local means of paint and surroundings, where no plane describes these."""

from __future__ import annotations

from typing import Final

import cv2
import numpy as np

from rhot_capture.detection.subpixel.shares import MIN_STEP, CoverageArray

_LOCAL_PX: Final = 1.7
"""σ of the weights of pure paint and surroundings by distance."""
_LOCAL_SIZE: Final = (11, 11)


def local_share(t: CoverageArray, weights: CoverageArray, shape: tuple[int, int]) -> CoverageArray:
    """Return the painted share of a window's pixels, (H·W,).

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
