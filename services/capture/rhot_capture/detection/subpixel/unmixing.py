"""What of a pixel's colour is paint: the algebra of `subpixel.centers`, on sums over pixels alone.

In plain numbers: for a handful of markers twenty calls of numpy on arrays of three by three cost twice as much.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final, NamedTuple

Vector = tuple[float, float, float]
Line = tuple[float, float, float, float]

_NOISE: Final = 5.0
"""σ, grey levels: variation of the surroundings that is no reason to avoid a direction."""
_MIN_CONTRAST: Final = 12.0
"""Grey levels between paint and surroundings below which their mixture cannot be told."""
_MIN_SURROUNDINGS: Final = 8
_RIDGE: Final = 30.0
"""Holds the slopes of a level against noise where there are few pixels; measured."""
_TINY: Final = 1e-6
_MISFIT: Final = 1.6
"""Deviation of pure paint from its plane, in units of the noise, from which on the levels are local means."""


class Levels(NamedTuple):
    """Planes of t over a window: coefficients of 1, x, y.

    Attributes:
        outside: of the surroundings.
        inside: of the pure paint.
        misfit: whether a plane describes the pure paint badly.
    """

    outside: Vector
    inside: Vector
    misfit: bool


def projection(
    outside: Sequence[float],
    inside: Sequence[float],
    blue: Sequence[float],
    green: Sequence[float],
    red: Sequence[float],
) -> tuple[Line, bool]:
    """Return t as a function of blue, green, red, 1, and whether paint and surroundings can be told apart.

    Args:
        outside: sums of blue, green, red, 1 over the surroundings.
        inside: the same over the pure paint.
        blue, green, red: the same over the surroundings, times blue, green or red.
    """
    b, g, r, total = outside
    share = 1.0 / max(total, 1.0)
    b, g, r = b * share, g * share, r * share
    paint_share = 1.0 / max(inside[3], 1.0)
    x, y, z = inside[0] * paint_share - b, inside[1] * paint_share - g, inside[2] * paint_share - r
    bb, bg, br, _ = blue
    gg, gr, rr = green[1], green[2], red[2]
    u, v, w = _solved(
        (bb * share - b * b + _NOISE**2, bg * share - b * g, br * share - b * r),
        (gg * share - g * g + _NOISE**2, gr * share - g * r, rr * share - r * r + _NOISE**2),
        (x, y, z),
    )
    scale = 1.0 / max(u * x + v * y + w * z, 1e-9)
    u, v, w = u * scale, v * scale, w * scale
    usable = total >= _MIN_SURROUNDINGS and x * x + y * y + z * z >= _MIN_CONTRAST**2
    return (u, v, w, -(u * b + v * g + w * r)), usable


def fitted_levels(
    line: Line, places: Sequence[Sequence[float]], products: Sequence[Sequence[float]], squares: float
) -> Levels:
    """Return the planes that fit t best.

    Args:
        line: t of blue, green, red, 1.
        places: sums of 1, x, y, x², xy, y² over the surroundings and over the pure paint.
        products: sums of the products of t with 1, x, y over both.
        squares: sum of t² over the pure paint.
    """
    n, x, y, xx, xy, yy = places[0]
    outside = _solved((n + _TINY, x, y), (xx + _RIDGE, xy, yy + _RIDGE), products[0])
    n, x, y, xx, xy, yy = places[1]
    inside = _solved((n + _TINY, x, y), (xx + _RIDGE, xy, yy + _RIDGE), products[1])
    # What a least-squares fit leaves over of the pure paint's t, against what noise alone would.
    level, slope_x, slope_y = inside
    t, tx, ty = products[1]
    left_over = squares - level * t - slope_x * tx - slope_y * ty
    u, v, w, _ = line
    noise = (_MISFIT * _NOISE) ** 2 * (u * u + v * v + w * w) * n
    return Levels(outside, inside, left_over > noise)


def _solved(first: Vector, rest: Vector, right: Sequence[float]) -> Vector:
    """Return the solution of a symmetric equation.

    Args:
        first: first row of the positive definite matrix.
        rest: entries (2, 2), (2, 3) and (3, 3) of it.
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
