"""Lens distortion: the rational Brown–Conrady model of OpenCV (`calib3d`, `projectPoints`).

With (x, y) = (X/Z, Y/Z) in the camera frame and r² = x² + y²:

    s = (1 + k1·r² + k2·r⁴ + k3·r⁶) / (1 + k4·r² + k5·r⁴ + k6·r⁶)
    x' = x·s + 2·p1·x·y + p2·(r² + 2·x²)
    y' = y·s + p1·(r² + 2·y²) + 2·p2·x·y
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Final

import numpy as np

from rhot.arrays import FloatArray

RATIONAL: Final = 8
"""Most coefficients of this model, in OpenCV's order: k1, k2, p1, p2, k3, k4, k5, k6."""


@dataclass(frozen=True, slots=True)
class Distorted:
    """Normalised image coordinates behind a lens, with what their derivatives are made of.

    Attributes:
        xy: (..., 2) x' and y'.
        r2: (...) r², before the lens.
        radial: (...) s.
    """

    xy: FloatArray
    r2: FloatArray
    radial: FloatArray


def distorted(x: FloatArray, y: FloatArray, coefficients: Sequence[Any]) -> Distorted:
    """Return where a lens bends normalised image coordinates to.

    Args:
        x, y: (...) without unit.
        coefficients: at most `RATIONAL`, in OpenCV's order, each a number or an array that broadcasts against x and y.
            Those that are left out are 0.
    """
    padded = list(coefficients) + [0.0] * (RATIONAL - len(coefficients))
    k1, k2, p1, p2, k3, k4, k5, k6 = padded
    xx, yy, xy2 = x * x, y * y, 2.0 * x * y
    r2 = xx + yy
    radial = 1.0 + r2 * (k1 + r2 * (k2 + r2 * k3))
    if len(coefficients) > 5:  # k4 to k6
        radial = radial / (1.0 + r2 * (k4 + r2 * (k5 + r2 * k6)))
    xy = np.empty((*x.shape, 2))
    xy[..., 0] = x * radial + p1 * xy2 + p2 * (r2 + 2.0 * xx)
    xy[..., 1] = y * radial + p1 * (r2 + 2.0 * yy) + p2 * xy2
    return Distorted(xy, r2, radial)
