"""The gain of a Kalman filter, for the few measurements at a time that there are here."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from rhot.geometry.covariances import symmetric_inverse

FloatArray = NDArray[np.float64]


def kalman_gain(PHt: FloatArray, H: FloatArray, noise: FloatArray) -> FloatArray:
    """Return K = P·Hᵀ·(H·P·Hᵀ + N)⁻¹, (n, m).

    Args:
        PHt: (n, m) covariance of the state times the transposed derivative.
        H: (m, n) derivative of the measurement by the state.
        noise: (m, m) covariance of the measurement.
    """
    S = H @ PHt + noise
    if len(S) == 3:
        K: FloatArray = PHt @ symmetric_inverse(S)
        return K
    return np.asarray(np.linalg.solve(S, PHt.T), dtype=np.float64).T
