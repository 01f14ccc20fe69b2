"""The equations of an alignment and their solution: a sensor's yaw, lever and bias, and how it hangs on the foot.

Places give rows that are linear in (cos ψ, sin ψ, l, b), see `alignment`: one least-squares problem on the circle
cos² + sin² = 1. Lever and bias are eliminated, all yaws are tried: no start value is needed, so no yaw is too wrong.

Orientations count as well: with the mounting M = R_sensor_foot, A_k = R_level_foot = Rz(ψ)·R_world_sensor·M. For each
yaw the best M is the rotation nearest to S(ψ) = Σ w_k·(Rz(ψ)·R_world_sensor)ᵀ·A_k with w_k = 1/σ_k², and what it leaves
is 3·K − tr(Mᵀ·S), K = Σ w_k: the sum of squared angles over their variances. It determines the yaw once the foot has
been tilted; both costs are added.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Final

import numpy as np

from rhot.arrays import FloatArray
from rhot.geometry.rotations import nearest_rotation

_LEVER_M: Final = 0.15
"""How far the marker may be from the sensor, and the sensor from where it should be worn, per axis, one sigma."""
_WORN_M: Final = 0.08
_MEMORY: Final = 0.97
"""Weight that older stretches and steps keep at each new one: the sensor's north drifts."""


# Yaws that are tried around the circle.
_CIRCLE: Final = np.linspace(-math.pi, math.pi, 240, endpoint=False)
UNKNOWNS: Final = 8
"""cos ψ, sin ψ, lever, bias."""
# Of the accelerometer, per axis; a BNO080's linear acceleration is good to 0.35 (data sheet).
PRIOR: Final = np.diag(np.r_[np.full(2, 1e-6), np.full(3, _LEVER_M**-2), np.full(3, 0.2**-2)])
"""(8, 8) information about them before anything was measured."""
_WORN: Final = np.diag(np.r_[np.full(3, _WORN_M**-2 - _LEVER_M**-2), np.zeros(3)])
_RZ_PARTS: Final = np.array(
    [
        [[0.0, 0.0, 0.0], [0.0, 0.0, 0.0], [0.0, 0.0, 1.0]],
        [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 0.0]],
        [[0.0, 1.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 0.0, 0.0]],
    ]
)
"""Rz(−ψ) = [0] + cos ψ·[1] + sin ψ·[2]."""


@dataclass(frozen=True, slots=True)
class Alignment:
    """How a sensor sits, as far as it is known.

    Attributes:
        yaw_rad: ψ, from the sensor's level world to the rig's.
        yaw_sigma_rad: its standard deviation.
        lever: (3,) from the sensor to the foot's origin, metres, sensor frame.
        bias: (3,) of the accelerometer, m/s².
        covariance: (6, 6) of lever and bias, were the yaw right.
        d_yaw: (6,) derivative of lever and bias by the yaw.
        M: R_sensor_foot (3, 3), the identity while no orientation of the marker was seen.
        mounting_known: M was measured.
    """

    yaw_rad: float
    yaw_sigma_rad: float
    lever: FloatArray
    bias: FloatArray
    covariance: FloatArray
    d_yaw: FloatArray
    M: FloatArray
    mounting_known: bool


class AlignmentEquations:
    """Gathers equations, the older the lighter, and solves them for the alignment."""

    def __init__(self, sensor_m: FloatArray) -> None:
        """Begin with nothing.

        Args:
            sensor_m: (3,) about where a sensor is worn, foot frame.
        """
        self._sensor_m = sensor_m
        self._information = PRIOR.copy()
        self._moment = np.zeros(UNKNOWNS)
        self._energy = self._rows = 0.0
        # S(ψ) = S[0] + cos ψ·S[1] + sin ψ·S[2], and K.
        self._S = np.zeros((3, 3, 3))
        self._K = 0.0
        self._orientation_ns = 0

    def add_positions(self, rows: FloatArray, values: FloatArray, sigma: float) -> None:
        """Add equations.

        Args:
            rows: (n, 8) factors of cos ψ, sin ψ, lever and bias.
            values: (n,) right sides, metres.
            sigma: noise of each, metres.
        """
        self._information = _MEMORY * self._information + (1.0 - _MEMORY) * PRIOR + rows.T @ rows / sigma**2
        self._moment = _MEMORY * self._moment + rows.T @ values / sigma**2
        self._energy = _MEMORY * self._energy + float(values @ values) / sigma**2
        self._rows = _MEMORY * self._rows + len(values)

    def add_orientation(
        self, t_ns: int, R_world_sensor: FloatArray, R_level_foot: FloatArray, sigma_rad: float
    ) -> None:
        """Add the orientations of sensor and foot at one moment, (3, 3) each, with the marker's noise per axis."""
        since_s = 1e-9 * max(t_ns - self._orientation_ns, 0)
        kept, weight = (
            # Time constant with which orientations are forgotten.
            math.exp(-since_s / 16.0),
            # Pictures this close see a marker's orientation with much the same error and count as one.
            min(since_s / 0.1, 1.0) / sigma_rad**2,
        )
        self._orientation_ns = max(t_ns, self._orientation_ns)
        added = weight * np.einsum("ji,ajl,lm->aim", R_world_sensor, _RZ_PARTS, R_level_foot)
        self._S = kept * self._S + added
        self._K = kept * self._K + weight

    def solve(self) -> Alignment | None:
        """Return what is known; None until the yaw is."""
        N, m = self._information, self._moment
        covariance = np.linalg.inv(N[2:, 2:])
        gain = N[:2, 2:] @ covariance
        reduced, aim = N[:2, :2] - gain @ N[2:, :2], m[:2] - gain @ m[2:]
        around = np.stack([np.cos(_CIRCLE), np.sin(_CIRCLE)])
        costs = np.einsum("ik,ij,jk->k", around, reduced, around) - 2.0 * aim @ around
        best = int(costs.argmin())
        total = self._energy + float(costs[best]) - float(m[2:] @ covariance @ m[2:])
        # Mean squared normalised residual above which the stretches do not agree with each other.
        if total > 16.0 * max(self._rows, 1.0):
            return None
        costs += 3.0 * self._K - _fits(self._summed(_CIRCLE))
        best = int(costs.argmin())
        # A parabola through the lowest cost and its neighbours; its curvature is twice the information.
        left, low, right = costs[best - 1], costs[best], costs[(best + 1) % len(costs)]
        spacing = float(_CIRCLE[1] - _CIRCLE[0])
        bend = float(left - 2.0 * low + right)
        if bend <= 0.0:
            return None
        yaw = float(_CIRCLE[best]) + 0.5 * spacing * float(left - right) / bend
        yaw_sigma = spacing * math.sqrt(2.0 / bend)
        # A yaw known this well is enough for the filter to start from; it refines the yaw.
        if yaw_sigma > math.radians(25.0):
            return None
        aim = m[2:] - N[2:, :2] @ np.array([math.cos(yaw), math.sin(yaw)])
        mounting_known, M = self._K > 0.0, np.eye(3)
        if mounting_known:
            # Now that the foot's axes are known, so is where on the foot the sensor has to be, about.
            M = nearest_rotation(self._summed(np.array([yaw]))[0])
            covariance = np.linalg.inv(N[2:, 2:] + _WORN)
            aim[:3] -= (M @ self._sensor_m) / _WORN_M**2
        solution = covariance @ aim
        d_yaw = covariance @ N[2:, :2] @ np.array([math.sin(yaw), -math.cos(yaw)])
        return Alignment(yaw, yaw_sigma, solution[:3], solution[3:], covariance, d_yaw, M, mounting_known)

    def _summed(self, yaws_rad: FloatArray) -> FloatArray:
        """Return S(ψ) (n, 3, 3) of yaws (n,)."""
        first, second, third = self._S
        summed: FloatArray = first + np.cos(yaws_rad)[:, None, None] * second + np.sin(yaws_rad)[:, None, None] * third
        return summed


def _fits(S: FloatArray) -> FloatArray:
    """Return the greatest tr(Mᵀ·S) (n,) over rotations M for matrices (n, 3, 3)."""
    sizes = np.linalg.svd(S, compute_uv=False)
    fits: FloatArray = sizes[:, 0] + sizes[:, 1] + np.sign(np.linalg.det(S)) * sizes[:, 2]
    return fits
