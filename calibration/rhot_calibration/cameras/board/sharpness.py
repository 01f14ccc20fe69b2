"""How sharp a picture of a board is, from the edges of its squares."""

from __future__ import annotations

from typing import Final

import cv2
import numpy as np
from numpy.typing import NDArray

from rhot.arrays import FloatArray, IntArray
from rhot_calibration.cameras.solve.views import Board

_SAMPLES: Final = 33
_REACH: Final = 0.3  # of a square, to either side of an edge
_MIN_CONTRAST: Final = 10.0


def edge_width_px(gray: NDArray[np.uint8], board: Board, ids: IntArray, corners: FloatArray) -> float:
    """Return the median distance over which the edges between neighbouring corners rise from 10 to 90 %.

    An edge is crossed in the middle between two neighbours, along the line to the centres of the squares beside it.

    Args:
        gray: (height, width).
        board: of the corners.
        ids: (n,) indices into `Board.points`.
        corners: (n, 2) pixels.

    Returns:
        pixels; 0 = no edge could be measured.
    """
    flat = np.full((board.rows * board.columns, 2), np.nan)
    flat[ids] = corners
    grid: FloatArray = flat.reshape(board.rows, board.columns, 2)
    profiles = np.concatenate([_crossings(grid), _crossings(np.swapaxes(grid, 0, 1))])
    profiles = profiles[np.isfinite(profiles).all(axis=(1, 2))]
    if not len(profiles):
        return 0.0
    maps = profiles.astype(np.float32)
    values = cv2.remap(gray, maps[..., 0], maps[..., 1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    levels: FloatArray = np.asarray(values, dtype=np.float64)
    rising = (levels[:, 0] <= levels[:, -1])[:, None]
    levels = np.where(rising, levels, np.fliplr(levels))
    low, high = levels[:, :4].mean(axis=1), levels[:, -4:].mean(axis=1)
    clear = high - low > _MIN_CONTRAST
    if not clear.any():
        return 0.0
    share = (levels[clear] - low[clear, None]) / (high - low)[clear, None]
    step = np.linalg.norm(profiles[clear, -1] - profiles[clear, 0], axis=1) / (_SAMPLES - 1)
    rise = (_crossing(share, 0.9) - _crossing(share, 0.1)) * step
    return float(np.median(rise))


def _crossings(grid: FloatArray) -> FloatArray:
    """Return lines (n, samples, 2) across the edges that run along the rows of a grid, without the outermost rows."""
    middle = 0.5 * (grid[1:-1, 1:] + grid[1:-1, :-1])
    across = 0.25 * (grid[2:, 1:] + grid[2:, :-1] - grid[:-2, 1:] - grid[:-2, :-1])
    offsets = np.linspace(-_REACH, _REACH, _SAMPLES)
    lines: FloatArray = (middle[..., None, :] + offsets[:, None] * across[..., None, :]).reshape(-1, _SAMPLES, 2)
    return lines


def _crossing(share: FloatArray, level: float) -> FloatArray:
    """Return the (fractional) sample at which each row of `share` (n, samples) first exceeds a level."""
    after = np.maximum(np.argmax(share > level, axis=1), 1)
    row = np.arange(len(share))
    before_value, after_value = share[row, after - 1], share[row, after]
    fraction: FloatArray = after - 1 + (level - before_value) / np.maximum(after_value - before_value, 1e-9)
    return fraction
