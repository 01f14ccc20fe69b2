"""The standard detectors of zero velocity over whole recordings, to compare the live one with.

All are tests over a window of n samples of specific force f (m/s²) and angular rate ω (rad/s); small means still:

    SHOE  = mean(|f − g·f̄/|f̄||²/σ_a² + |ω|²/σ_ω²)      (generalised likelihood ratio test)
    ARED  = mean(|ω|²)/σ_ω²                            (energy of the angular rate)

Source: Skog, Händel, Nilsson and Rantakokko, "Zero-velocity detection: an algorithm evaluation", IEEE Transactions on
Biomedical Engineering 57 (11), 2010.
"""

from __future__ import annotations

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view

from rhot.arrays import FloatArray
from rhot_feet.imu.samples import GRAVITY_M_S2
from rhot_feet.imu.zero_velocity_detector import ACCELERATION_NOISE, RATE_NOISE


def _windows(values: FloatArray, size: int) -> FloatArray:
    """Return (N, size, 3): the centred window of each of the rows (N, 3); the ends repeat the outermost row."""
    before = (size - 1) // 2
    padded = np.pad(values, ((before, size - 1 - before), (0, 0)), mode="edge")
    windows: FloatArray = sliding_window_view(padded, size, axis=0).swapaxes(1, 2)
    return windows


def shoe(specific_force: FloatArray, angular_rate: FloatArray, size: int = 5) -> FloatArray:
    """Return the SHOE statistic (N,) of samples (N, 3) and (N, 3), over centred windows of `size`."""
    f, w = _windows(specific_force, size), _windows(angular_rate, size)
    mean = f.mean(axis=1, keepdims=True)
    gravity = GRAVITY_M_S2 * mean / np.maximum(np.linalg.norm(mean, axis=2, keepdims=True), 1e-9)
    force = ((f - gravity) ** 2).sum(axis=2) / ACCELERATION_NOISE**2
    statistic: FloatArray = (force + (w * w).sum(axis=2) / RATE_NOISE**2).mean(axis=1)
    return statistic


def ared(angular_rate: FloatArray, size: int = 5) -> FloatArray:
    """Return the energy of the angular rate (N,) of samples (N, 3), over centred windows of `size`."""
    w = _windows(angular_rate, size)
    statistic: FloatArray = (w * w).sum(axis=2).mean(axis=1) / RATE_NOISE**2
    return statistic
