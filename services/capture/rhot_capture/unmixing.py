"""What of a pixel's colour is paint: the algebra of `rhot_capture.subpixel`, on sums of products alone.

A pixel's features are blue, green, red, 1, x, y; moments are the sums of their products, (N, 2, 6, 6): N blobs, in the
surroundings and in the pure paint of each.
"""

from __future__ import annotations

from typing import Final

import numpy as np
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]

_NOISE: Final = 5.0
"""σ, grey levels: variation of the surroundings that is no reason to avoid a direction."""
_VARIATION: Final = _NOISE**2 * np.eye(3)
_MIN_CONTRAST: Final = 12.0
"""Grey levels between paint and surroundings below which their mixture cannot be told."""
_MIN_SURROUNDINGS: Final = 8
_RIDGE: Final = np.diag((1e-6, 30.0, 30.0))
"""Holds the slopes of a level against noise where there are few pixels; measured."""
_MISFIT: Final = 1.6
"""Deviation of pure paint from its plane, in units of the noise, from which on the levels are local means."""


def projections(moments: FloatArray) -> tuple[FloatArray, list[bool]]:
    """Return t as a function of blue, green, red, 1, and whether paint and surroundings can be told apart.

    Args:
        moments: (N, 2, 6, 6) see above.

    Returns:
        (N, 4) coefficients; N truths.
    """
    totals = np.maximum(moments[:, :, 3, 3], 1.0)
    means = moments[:, :, 3, :3] / totals[:, :, None]
    outside = means[:, 0]
    paint = means[:, 1] - outside
    spread = moments[:, 0, :3, :3] / totals[:, :1, None] - outside[:, :, None] * outside[:, None] + _VARIATION
    direction = _solved(spread, paint)
    direction /= np.maximum((direction * paint).sum(axis=1, keepdims=True), 1e-9)
    line = np.empty((len(moments), 4))
    line[:, :3] = direction
    line[:, 3] = -(direction * outside).sum(axis=1)
    usable = (totals[:, 0] >= _MIN_SURROUNDINGS) & ((paint * paint).sum(axis=1) >= _MIN_CONTRAST**2)
    return line, usable.tolist()


def _solved(matrices: FloatArray, right: FloatArray) -> FloatArray:
    """Return the solutions of symmetric equations, (N, 3); in plain numbers, faster than a call of LAPACK.

    Args:
        matrices: (N, 3, 3), positive definite.
        right: (N, 3).
    """
    solved = []
    for ((a, b, c), (_, d, e), (_, _, f)), (x, y, z) in zip(matrices.tolist(), right.tolist(), strict=True):
        aa, ab, ac = d * f - e * e, c * e - b * f, b * e - c * d
        bb, bc, cc = a * f - c * c, b * c - a * e, a * d - b * b
        scale = 1.0 / (a * aa + b * ab + c * ac)
        solved.append(
            (
                (aa * x + ab * y + ac * z) * scale,
                (ab * x + bb * y + bc * z) * scale,
                (ac * x + bc * y + cc * z) * scale,
            )
        )
    return np.array(solved)


def shares_of_features(moments: FloatArray, line: FloatArray) -> tuple[FloatArray, list[bool]]:
    """Return α from both levels, and whether planes describe the paint badly.

    Args:
        moments: (N, 2, 6, 6) see above.
        line: (N, 4), t of blue, green, red, 1.

    Returns:
        (N, 2, 6) numerator and denominator of α as functions of blue, green, red, 1, x, y; N truths.
    """
    products = (moments[:, :, :, :4] @ line[:, None, :, None])[..., 0]
    fits = (moments[:, :, 3:, 3:] + _RIDGE).reshape(-1, 3, 3)
    levels = _solved(fits, products[:, :, 3:].reshape(-1, 3)).reshape(-1, 2, 3)
    # α = (t − t₀)/(t₁ − t₀)
    parts = np.zeros((len(line), 2, 6))
    parts[:, 0, :4] = line
    parts[:, 0, 3:] -= levels[:, 0]
    parts[:, 1, 3:] = levels[:, 1] - levels[:, 0]
    # What a least-squares fit leaves over of the pure paint's t, against what noise alone would.
    left_over = (line * products[:, 1, :4]).sum(axis=1) - (levels[:, 1] * products[:, 1, 3:]).sum(axis=1)
    noise = (_MISFIT * _NOISE) ** 2 * (line[:, :3] ** 2).sum(axis=1) * moments[:, 1, 3, 3]
    return parts, (left_over > noise).tolist()
