"""Spectral unmixing of paint and surroundings: the algebra of `subpixel.centers`, on sums over pixels.

Uses plain floats: for a few 3x3 systems numpy's call overhead dominates. This must save at least a tenth of a frame's
time to be worth keeping; `rhot bench --part capture` measures it.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final, cast

from rhot_capture.detection.subpixel.shares import CoverageArray

Vector = tuple[float, float, float]
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
) -> tuple[list[Vector], list[bool]]:
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


def _plane(sums: Sequence[float], products: Sequence[float]) -> Vector:
    n, x, y, xx, xy, yy = sums
    return _solved((n + TINY, x, y), (xx + RIDGE, xy, yy + RIDGE), products)


def _solved(first: Vector, rest: Vector, right: Sequence[float]) -> Vector:
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
