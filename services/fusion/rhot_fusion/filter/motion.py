"""How the markers of one hand move together.

The acceleration a of a hand is correlated in time (R. A. Singer, "Estimating optimal tracking filter performance for
manned maneuvering targets", IEEE Trans. AES-6, 1970). With white noise w of power s²,

    da/dt = −a / τ + w / τ,

which is white acceleration of power s² below the frequency 1 / (2π τ) and weaker above it. Each marker also has white
acceleration of its own (Bar-Shalom, Li and Kirubarajan, "Estimation with Applications to Tracking and Navigation",
2001, section 6.2.2):

    d²p/dt² = a + s own w',

and a share of the common noise acts without correlation. Each marker's motion therefore updates all others, visible or
hidden. The scale s is unknown and changes over time: a hand at rest is averaged over many frames, a fast one is
followed at once. It takes one of a few values, which are weighted by the likelihood of the observations; the weights
return to their prior within `SWITCH_S`.

The three axes move alike and independently, so that all matrices are those of one axis, (2 M + 1)², times the identity.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import lru_cache
from typing import Final

import numpy as np

from rhot.arrays import FloatArray

_OWN: Final = 1.0
"""Strength of each marker's individual acceleration, relative to that of its hand."""
_JOINING_S: Final = 0.2
"""Time constant with which a marker's velocity returns to that of its hand, seconds; a finger bends and comes to rest
in 0.2 to 0.4 s.
"""
_PERSISTS_S: Final = 0.08
"""Correlation time of the shared acceleration, seconds: a corner frequency of 2 Hz, because reaches last 0.4 to 0.8 s
(Flash and Hogan, J. Neurosci. 5(7), 1985). For a swing at 1.2 Hz, errors are the same between 0.06 and 0.12.
"""
_ABRUPT: Final = 0.5
"""Share of the shared acceleration that is white instead: a hand that hits a table stops at once, and so do its hidden
markers.
"""

_SERIES = 0.05
"""Below this share of τ the leading terms of the noise are exact to 2 %, and the closed forms lose precision."""
_EYE: FloatArray = np.eye(3)[None, :, None, :]


def transition(alive: tuple[bool, ...], dt: float) -> FloatArray:
    """Return F (n, n) over a time step, seconds, where some of the markers (M,) are tracked; n = 6 M + 3."""
    tau = _PERSISTS_S
    share, fade = -math.expm1(-dt / _JOINING_S), math.exp(-dt / tau)
    gained = -tau * math.expm1(-dt / tau)
    return _of_all_axes((1.0, dt, share, fade, tau * (dt - gained), gained), _matrices(alive)[0])


def noise(alive: tuple[bool, ...], dt: float) -> FloatArray:
    """Return the process noise Q (n, n) over a time step, seconds, at the scale 1."""
    pp, pv, vv = dt**3 / 3.0, dt**2 / 2.0, dt
    s_pp, s_pv, s_pa, s_vv, s_va, s_aa = _singer(dt, _PERSISTS_S)
    white = _ABRUPT**2
    shared = (s_pp + white * pp, s_pv + white * pv, s_vv + white * vv, s_pa, s_va)
    return _of_all_axes((pp, pv, vv, s_aa, *shared), _matrices(alive)[1])


@lru_cache
def _matrices(alive: tuple[bool, ...]) -> tuple[FloatArray, FloatArray]:
    """Return what the coefficients of `transition` (6, (2 M + 1)²) and `noise` (9, (2 M + 1)²) multiply, one axis."""
    count, there = len(alive), np.array(alive, dtype=np.float64)
    n = 2 * count + 1
    p, v, a = slice(count), slice(count, 2 * count), slice(2 * count, None)
    F, Q = np.zeros((6, n, n)), np.zeros((9, n, n))
    F[0, p, p] = F[0, v, v] = np.eye(count)
    F[1, p, v] = np.diag(there)
    if (number := there.sum()) > 1.0:
        F[2, v, v] = np.outer(there, there) / number - np.diag(there)
    F[3, a, a] = 1.0
    F[4, p, a] = F[5, v, a] = there[:, None]
    Q[0, p, p] = Q[1, p, v] = Q[1, v, p] = Q[2, v, v] = _OWN**2 * np.diag(there)
    Q[3, a, a] = 1.0
    Q[4, p, p] = Q[5, p, v] = Q[5, v, p] = Q[6, v, v] = np.outer(there, there)
    Q[7, p, a] = Q[8, v, a] = there[:, None]
    Q[7, a, p] = Q[8, a, v] = there
    return F.reshape(6, -1), Q.reshape(9, -1)


def _singer(dt: float, tau: float) -> tuple[float, ...]:
    """Return the covariances pp, pv, pa, vv, va, aa of Singer's acceleration with power 1 at low frequencies."""
    b = dt / tau
    q = 1.0 / tau**2
    if b < _SERIES:
        return (
            q * dt**5 / 20.0,
            q * dt**4 / 8.0,
            q * dt**3 / 6.0,
            q * dt**3 / 3.0,
            q * dt**2 / 2.0,
            q * dt,
        )
    e, e2 = math.exp(-b), math.exp(-2.0 * b)
    return (
        tau**3 / 2.0 * (1.0 - e2 + 2.0 * b + 2.0 * b**3 / 3.0 - 2.0 * b**2 - 4.0 * b * e),
        tau**2 / 2.0 * (e2 + 1.0 - 2.0 * e + 2.0 * b * e - 2.0 * b + b**2),
        tau / 2.0 * (1.0 - e2 - 2.0 * b * e),
        tau / 2.0 * (4.0 * e - 3.0 - e2 + 2.0 * b),
        (e2 + 1.0 - 2.0 * e) / 2.0,
        (1.0 - e2) / (2.0 * tau),
    )


def _of_all_axes(coefficients: Sequence[float], matrices: FloatArray) -> FloatArray:
    """Return the sum of one axis' matrices, each times its coefficient, for all three axes."""
    axis = np.array(coefficients) @ matrices
    n = math.isqrt(len(axis))
    every: FloatArray = (axis.reshape(n, 1, n, 1) * _EYE).reshape(3 * n, 3 * n)
    return every
