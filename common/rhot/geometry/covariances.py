"""Small symmetric matrices without numpy.linalg, which takes three times as long, most of it around the arithmetic."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

import numpy as np

from rhot.arrays import FloatArray

_ROUNDING_M2: Final = 1e-8
"""A standard deviation of 0.1 mm, added before a covariance is judged."""


def symmetric_inverse(M: FloatArray) -> FloatArray:
    """Return the inverse of a symmetric positive definite matrix (3, 3), by its cofactors."""
    (a, b, c), (_, d, e), (_, _, f) = M.tolist()
    A, B, C = d * f - e * e, c * e - b * f, b * e - c * d
    scale = 1.0 / (a * A + b * B + c * C)
    A, B, C = A * scale, B * scale, C * scale
    E = (b * c - a * e) * scale
    return np.array([[A, B, C], [B, (a * f - c * c) * scale, E], [C, E, (a * d - b * b) * scale]])


def inverse_covariance(S: FloatArray) -> FloatArray:
    """Return the inverse of a covariance (N, N) of a few tens of rows, by Cholesky's decomposition.

    Raises:
        LinAlgError: it is singular.
    """
    import cv2  # noqa: PLC0415  # ik, which does not come here, is installed without OpenCV

    regular, inverse = cv2.invert(S, flags=cv2.DECOMP_CHOLESKY)
    # What rounding has left without a positive pivot may still have an inverse.
    return np.asarray(inverse, dtype=np.float64) if regular else np.asarray(np.linalg.inv(S), dtype=np.float64)


def squared_distances(vectors: FloatArray, covariances: FloatArray) -> list[float]:
    """Return the squared Mahalanobis distances vᵀ·C⁻¹·v of vectors (N, 3) under covariances (N, 3, 3)."""
    distances = []
    for (x, y, z), ((a, b, c), (_, d, e), (_, _, f)) in zip(vectors.tolist(), covariances.tolist(), strict=True):
        A, B, C = d * f - e * e, c * e - b * f, b * e - c * d
        D, E, F = a * f - c * c, b * c - a * e, a * d - b * b
        quadratic = A * x * x + D * y * y + F * z * z + 2.0 * (B * x * y + C * x * z + E * y * z)
        distances.append(quadratic / (a * A + b * B + c * C))
    return distances


def stated_covariance(covariance: Sequence[float] | None, sigma: float) -> tuple[float, ...]:
    """Return the covariance (9,) of a point's error, m², row by row.

    A point without one states the root of the summed variances alone, which is then taken as alike in all directions.
    """
    if covariance is None:
        variance = sigma**2 / 3.0
        return (variance, 0.0, 0.0, 0.0, variance, 0.0, 0.0, 0.0, variance)
    xx, xy, xz, yy, yz, zz = covariance
    return (xx, xy, xz, xy, yy, yz, xz, yz, zz)


def has_covariance(covariance: Sequence[float] | None, sigma: float) -> bool:
    """Return whether what a point states can be a covariance: positive (Sylvester's criterion) but for rounding."""
    a, b, c, _, d, e, _, _, f = stated_covariance(covariance, sigma)
    a, d, f = a + _ROUNDING_M2, d + _ROUNDING_M2, f + _ROUNDING_M2
    two = a * d - b * b
    return a > 0.0 and two > 0.0 and f * two > a * e * e - 2.0 * b * c * e + c * c * d


def squared_distance(vector: FloatArray, covariance: FloatArray) -> float:
    """Return the squared Mahalanobis distance vᵀ·C⁻¹·v of a vector (3,) under a covariance (3, 3)."""
    (distance,) = squared_distances(vector[None], covariance[None])
    return max(0.0, distance)
