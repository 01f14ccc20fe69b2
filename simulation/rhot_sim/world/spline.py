"""Smooth curves that can be asked for at any time: uniform cubic B-splines over control values.

With knots every h seconds, k = ⌊t/h⌋ and u = t/h − k, the curve is the sum of B_i(u) · c[k − 1 + i], i = 0…3 (de Boor,
"A Practical Guide to Splines", ch. IX). It is twice continuously differentiable and lies in the convex hull of its
four controls, so that controls within limits give a curve within limits, and equal controls a curve that stands still.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from rhot.arrays import FloatArray


def evaluate_spline(t_s: FloatArray, knot_s: float, control: Callable[[int], FloatArray]) -> FloatArray:
    """Return the curve at times `t_s` (N,), seconds, as (N, C).

    Args:
        t_s: any times in any order.
        knot_s: distance of the knots, seconds.
        control: returns the control values (C,) of a knot by its number.
    """
    knots = np.asarray(t_s, dtype=np.float64) / knot_s
    knot = np.floor(knots).astype(np.int64)
    weights = basis(knots - knot)
    first, last = int(knot.min()) - 1, int(knot.max()) + 2
    if last - first <= 4 * len(knot) + 4:
        table = np.stack([control(k) for k in range(first, last + 1)])
        index = knot[:, None] + np.arange(4) - 1 - first
    else:
        wanted, inverse = np.unique(knot[:, None] + np.arange(-1, 3), return_inverse=True)
        table = np.stack([control(int(k)) for k in wanted])
        index = inverse.reshape(-1, 4)
    curve: FloatArray = np.einsum("nk,nkc->nc", weights, table[index])
    return curve


def basis(u: FloatArray) -> FloatArray:
    """Return the four weights (N, 4) of the uniform cubic B-spline at u (N,) in [0, 1); they sum to 1."""
    v = 1.0 - u
    return np.stack([v**3, 3.0 * u**3 - 6.0 * u**2 + 4.0, 3.0 * v**3 - 6.0 * v**2 + 4.0, u**3], axis=-1) / 6.0


def ramp(t: FloatArray, start: float, end: float) -> FloatArray:
    """Return 0 before `start`, 1 after `end` and a smooth step (3x² − 2x³) between."""
    x = np.clip((t - start) / (end - start), 0.0, 1.0)
    smooth: FloatArray = x * x * (3.0 - 2.0 * x)
    return smooth


def bump(t: FloatArray, start: float, end: float, edge: float) -> FloatArray:
    """Return 1 within [start + edge, end − edge], 0 outside [start, end], smooth between."""
    rising: FloatArray = ramp(t, start, start + edge) * (1.0 - ramp(t, end - edge, end))
    return rising
