"""How the markers of one hand move together.

A hand's linear and angular acceleration (a, α) persist for a while (R. A. Singer, "Estimating optimal tracking filter
performance for manned maneuvering targets", IEEE Trans. AES-6, 1970): with white noise w of power s²,

    d(a, α)/dt = −(a, α) / τ + (common, turning) w / τ,

which is white acceleration of power s² below the frequency 1 / (2π τ) and less above it. Each marker at r about the
middle of its hand's also has white acceleration of its own (Bar-Shalom, Li and Kirubarajan, "Estimation with
Applications to Tracking and Navigation", 2001, section 6.2.2):

    d²p/dt² = a + α × r + s own w',

and a share of the common noise acts at once. So what one marker does tells of the others, seen or hidden. The scale s
is not known and changes: a still hand is averaged over many frames, a fast one is followed at once. It is one of a few
values, weighed by how well each foretells the observations, and forgotten within `switch_s`.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from rhot_fusion.filter.settings import MotionSettings
from rhot_fusion.filter.state import SHARED, BoolArray

FloatArray = NDArray[np.float64]

_EYE: FloatArray = np.eye(3)
_SERIES = 0.05
"""Below this share of τ, the leading terms of the noise are exact to 2 %, and closed forms lose their digits."""


@dataclass(frozen=True, slots=True)
class Motion:
    """The motion of markers at given places, as matrices of a state (6 M + 6) for any time.

    Attributes:
        place: (M, 3) metres, of the markers.
        alive: (M,) which of them there are.
        transitions: (6, n²) what the coefficients of `transition` multiply.
        noises: (9, n²) what those of `noise` multiply.
    """

    place: FloatArray
    alive: BoolArray
    transitions: FloatArray
    noises: FloatArray

    def transition(self, dt: float, settings: MotionSettings) -> FloatArray:
        """Return F (n, n) over a time, seconds."""
        tau = settings.persists_s
        share, fade = -math.expm1(-dt / settings.joining_s), math.exp(-dt / tau)
        gained = -tau * math.expm1(-dt / tau)
        coefficients = np.array((1.0, dt, share, tau * (dt - gained), gained, fade))
        return _combined(coefficients, self.transitions)

    def noise(self, dt: float, settings: MotionSettings) -> FloatArray:
        """Return Q (n, n) over a time, seconds, for the scale 1."""
        white = (dt**3 / 3.0, dt**2 / 2.0, dt)
        return _combined(np.array((*white, *_singer(dt, settings.persists_s))), self.noises)


def motion_of(place: FloatArray, alive: BoolArray, settings: MotionSettings) -> Motion:
    """Return the motion of those markers at places (M, 3) that are alive (M,)."""
    count = len(place)
    half, n = 3 * count, 6 * count + SHARED
    there = np.flatnonzero(alive)
    rows = (there[:, None] * 3 + np.arange(3)).ravel()
    B = np.zeros((half, SHARED))
    B[rows] = lever(place[there], settings)
    p, v, z = slice(0, half), slice(half, 2 * half), slice(2 * half, n)
    F = np.zeros((6, n, n))
    F[0][np.arange(2 * half), np.arange(2 * half)] = 1.0
    F[1][rows, half + rows] = 1.0
    if len(there) > 1:
        mean = np.kron(np.full((len(there), len(there)), 1.0 / len(there)), _EYE)
        F[2][np.ix_(half + rows, half + rows)] = mean - np.eye(len(rows))
    F[3][p, z] = B
    F[4][v, z] = B
    F[5][z, z] = np.eye(SHARED)
    D = np.repeat(np.square([settings.common, settings.turning]), 3)
    shared = (B * D) @ B.T
    white = settings.abrupt**2 * shared
    white[rows, rows] += settings.own**2
    Q = np.zeros((9, n, n))
    Q[0][p, p] = Q[2][v, v] = white
    Q[1][p, v] = Q[1][v, p] = white
    Q[3][p, p] = Q[6][v, v] = shared
    Q[4][p, v] = Q[4][v, p] = shared
    Q[5][p, z], Q[7][v, z] = B * D, B * D
    Q[5][z, p], Q[7][z, v] = (B * D).T, (B * D).T
    Q[8][z, z] = np.diag(D)
    return Motion(place, alive, F.reshape(6, -1), Q.reshape(9, -1))


def lever(place: FloatArray, settings: MotionSettings) -> FloatArray:
    """Return B (3 M, 6): the acceleration of markers at places (M, 3) by that of their hand, a + α × r."""
    arm = place - place.mean(axis=0) if len(place) else place
    length = np.sqrt((arm * arm).sum(axis=1))
    arm *= np.minimum(1.0, settings.longest_arm_m / np.maximum(length, 1e-9))[:, None]
    B = np.zeros((len(place), 3, SHARED))
    B[:, :, :3] = _EYE
    x, y, z = arm.T
    B[:, 0, 4], B[:, 0, 5] = z, -y
    B[:, 1, 3], B[:, 1, 5] = -z, x
    B[:, 2, 3], B[:, 2, 4] = y, -x
    return B.reshape(-1, SHARED)


def _singer(dt: float, tau: float) -> tuple[float, ...]:
    """Return the covariances pp, pv, pa, vv, va, aa of an acceleration that persists, of power 1 at low frequencies."""
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


def _combined(coefficients: FloatArray, matrices: FloatArray) -> FloatArray:
    combined: FloatArray = coefficients @ matrices
    n = math.isqrt(len(combined))
    return combined.reshape(n, n)
