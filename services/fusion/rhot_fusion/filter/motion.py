"""How the markers of one hand move together.

The linear and angular acceleration (a, α) of a hand are correlated in time (R. A. Singer, "Estimating optimal tracking
filter performance for manned maneuvering targets", IEEE Trans. AES-6, 1970). With white noise w of power s²,

    d(a, α)/dt = −(a, α) / τ + (common, turning) w / τ,

which is white acceleration of power s² below the frequency 1 / (2π τ) and weaker above it. Each marker, at r from the
centroid of its hand's markers, also has white acceleration of its own (Bar-Shalom, Li and Kirubarajan, "Estimation with
Applications to Tracking and Navigation", 2001, section 6.2.2):

    d²p/dt² = a + α × r + s own w',

and a share of the common noise acts without correlation. Each marker's motion therefore updates all others, visible or
hidden. The scale s is unknown and changes over time: a hand at rest is averaged over many frames, a fast one is
followed at once. It takes one of a few values, which are weighted by the likelihood of the observations; the weights
return to their prior within `SWITCH_S`.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Final

import numpy as np

from rhot.arrays import BoolArray, FloatArray
from rhot_fusion.filter.state import SHARED

_TURNING: Final = 8.0
"""Relative strength of the angular acceleration, per metre from the centroid of the markers."""
_OWN: Final = 1.0
"""Relative strength of each marker's individual acceleration."""
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

_EYE: FloatArray = np.eye(3)
_SERIES = 0.05
"""Below this share of τ the leading terms of the noise are exact to 2 %, and the closed forms lose precision."""


@dataclass(frozen=True, slots=True)
class MotionModel:
    """Transition and process noise of a state (n = 6 M + 6) over any time step, for given marker positions.

    Attributes:
        position: (M, 3) marker positions, metres.
        alive: (M,) which of them are tracked.
        index: of those; a slice where it is all of them, which costs no time.
        transitions: (6, n²) matrices multiplied by the coefficients of `transition`.
        noises: (9, n²) matrices multiplied by those of `noise`.
    """

    position: FloatArray
    alive: BoolArray
    index: BoolArray | slice
    transitions: FloatArray
    noises: FloatArray

    def transition(self, dt: float) -> FloatArray:
        """Return F (n, n) for a time step, seconds."""
        tau = _PERSISTS_S
        share, fade = -math.expm1(-dt / _JOINING_S), math.exp(-dt / tau)
        gained = -tau * math.expm1(-dt / tau)
        return _combined((1.0, dt, share, fade, tau * (dt - gained), gained), self.transitions)

    def noise(self, dt: float) -> FloatArray:
        """Return Q (n, n) for a time step, seconds, at the scale 1."""
        pp, pv, vv = dt**3 / 3.0, dt**2 / 2.0, dt
        s_pp, s_pv, s_pz, s_vv, s_vz, s_zz = _singer(dt, _PERSISTS_S)
        white = _ABRUPT**2
        shared = (s_pp + white * pp, s_pv + white * pv, s_vv + white * vv, s_pz, s_vz)
        return _combined((pp, pv, vv, s_zz, *shared), self.noises)


def motion_of(position: FloatArray, alive: BoolArray) -> MotionModel:
    """Return the motion of the markers at positions (M, 3), metres, of which some are alive (M,)."""
    half = 3 * len(position)
    p, v, z = slice(half), slice(half, 2 * half), slice(2 * half, None)
    F, Q = (constant.copy() for constant in _wherever(tuple(alive.tolist())))
    B = np.zeros((half, SHARED))
    B[np.repeat(alive, 3)] = lever(position[alive])
    F[4, p, z] = F[5, v, z] = B
    BD = B * _power()
    Q[4, p, p] = Q[5, p, v] = Q[5, v, p] = Q[6, v, v] = BD @ B.T
    Q[7, p, z] = Q[8, v, z] = BD
    Q[7, z, p] = Q[8, z, v] = BD.T
    index = slice(None) if alive.all() else alive
    return MotionModel(position, alive, index, F.reshape(6, -1), Q.reshape(9, -1))


@lru_cache
def _wherever(alive: tuple[bool, ...]) -> tuple[FloatArray, FloatArray]:
    """Return the position-independent parts of the transitions (6, n, n) and noises (9, n, n)."""
    there, number = np.repeat(alive, 3), sum(alive)
    half = len(there)
    n = 2 * half + SHARED
    p, v, z = slice(half), slice(half, 2 * half), slice(2 * half, None)
    F, Q = np.zeros((6, n, n)), np.zeros((9, n, n))
    F[0, p, p] = F[0, v, v] = np.eye(half)
    F[1, p, v] = np.diag(there)
    if number > 1:
        mean = np.tile(np.eye(3) / number, (number, number))
        F[2, v, v][np.ix_(there, there)] = mean - np.eye(3 * number)
    F[3, z, z] = np.eye(SHARED)
    own = _OWN**2 * np.diag(there)
    Q[0, p, p] = Q[1, p, v] = Q[1, v, p] = Q[2, v, v] = own
    Q[3, z, z] = np.diag(_power())
    return F, Q


def _power() -> FloatArray:
    """Return the noise power (6,) of the shared accelerations."""
    # Relative strength of the linear acceleration that all markers of a hand share.
    return np.repeat(np.square([1.0, _TURNING]), 3)


def lever(position: FloatArray) -> FloatArray:
    """Return B (3 M, 6), which maps the hand's acceleration to that of markers at positions (M, 3): a + α × r."""
    arm = position - position.mean(axis=0) if len(position) else position
    length = np.sqrt((arm * arm).sum(axis=1))
    # Upper bound of the lever arm about the hand's centroid, metres; half a hand.
    arm *= np.minimum(1.0, 0.1 / np.maximum(length, 1e-9))[:, None]
    B = np.zeros((len(position), 3, SHARED))
    B[:, :, :3] = _EYE
    x, y, z = arm.T
    B[:, 0, 4], B[:, 0, 5] = z, -y
    B[:, 1, 3], B[:, 1, 5] = -z, x
    B[:, 2, 3], B[:, 2, 4] = y, -x
    return B.reshape(-1, SHARED)


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


def _combined(coefficients: Sequence[float], matrices: FloatArray) -> FloatArray:
    combined: FloatArray = np.array(coefficients) @ matrices
    n = math.isqrt(len(combined))
    return combined.reshape(n, n)
