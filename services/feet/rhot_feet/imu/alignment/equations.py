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


@dataclass(frozen=True, slots=True)
class AlignmentSettings:
    """How a sensor's alignment is estimated; values without another source were chosen on `rhot evaluate feet`.

    Attributes:
        lever_m, worn_m: how far the marker may be from the sensor, and the sensor from where it should be worn, per
            axis, one sigma.
        bias_m_s2: of the accelerometer, per axis; a BNO080's linear acceleration is good to 0.35 (data sheet).
        memory: weight that older stretches and steps keep at each new one: the sensor's north drifts.
        orientation_memory_s: time constant with which orientations are forgotten.
        orientation_correlation_s: pictures this close see a marker's orientation with much the same error and count as
            one.
        yaw_rad: a yaw known this well is enough for the filter to start from; it refines the yaw.
        most_mean_nis: mean squared normalised residual above which the stretches do not agree with each other.
        yaws: that are tried around the circle.
        stretch_ns, stretch_positions: length of a stretch, and fewest positions in it.
        model_m: what the model leaves unexplained of a position in a stretch, per axis, on top of its own noise.
        worst_fit_m: a stretch that no yaw explains better than this, root mean square, holds a false marker.
        moved_sigmas: a stretch counts when the marker strays this many standard deviations, root mean square, from a
            straight line.
        step_m, step_share: error of a step by the sensor, per axis: so much, and this share of its length on top.
        false_step_m, false_step_share: a step that differs by more between pictures and sensor holds a false marker.
        shortest_step_m, longest_step_s: of the steps that are used; after longer the sensor alone has lost its way.
        gap_s: samples farther apart have others missing between them; the foot swings on meanwhile.
        sightings: of the marker, fewest on each side of a step.
        kept_stands: stand-stills that are remembered.
        lean_rad_s, lean_rad: a sensor mistakes acceleration for tilt: how fast its orientation goes wrong since it
            stood, and by how much at most (a BNO080 promises 3.5 degrees in motion).
        solve_every: sightings between two attempts to solve.
    """

    lever_m: float = 0.15
    worn_m: float = 0.08
    bias_m_s2: float = 0.2
    memory: float = 0.97
    orientation_memory_s: float = 16.0
    orientation_correlation_s: float = 0.1
    yaw_rad: float = math.radians(25.0)
    most_mean_nis: float = 16.0
    yaws: int = 240
    stretch_ns: int = 500_000_000
    stretch_positions: int = 12
    model_m: float = 0.004
    worst_fit_m: float = 0.03
    moved_sigmas: float = 6.0
    step_m: float = 0.02
    step_share: float = 0.03
    false_step_m: float = 0.06
    false_step_share: float = 0.15
    shortest_step_m: float = 0.12
    longest_step_s: float = 1.5
    gap_s: float = 0.035
    sightings: int = 3
    kept_stands: int = 12
    lean_rad_s: float = math.radians(10.0)
    lean_rad: float = math.radians(4.0)
    solve_every: int = 3


SETTINGS: Final = AlignmentSettings()
_CIRCLE: Final = np.linspace(-math.pi, math.pi, SETTINGS.yaws, endpoint=False)
UNKNOWNS: Final = 8
"""cos ψ, sin ψ, lever, bias."""
PRIOR: Final = np.diag(np.r_[np.full(2, 1e-6), np.full(3, SETTINGS.lever_m**-2), np.full(3, SETTINGS.bias_m_s2**-2)])
"""(8, 8) information about them before anything was measured."""
_WORN: Final = np.diag(np.r_[np.full(3, SETTINGS.worn_m**-2 - SETTINGS.lever_m**-2), np.zeros(3)])
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
        self._information = (
            SETTINGS.memory * self._information + (1.0 - SETTINGS.memory) * PRIOR + rows.T @ rows / sigma**2
        )
        self._moment = SETTINGS.memory * self._moment + rows.T @ values / sigma**2
        self._energy = SETTINGS.memory * self._energy + float(values @ values) / sigma**2
        self._rows = SETTINGS.memory * self._rows + len(values)

    def add_orientation(
        self, t_ns: int, R_world_sensor: FloatArray, R_level_foot: FloatArray, sigma_rad: float
    ) -> None:
        """Add the orientations of sensor and foot at one moment, (3, 3) each, with the marker's noise per axis."""
        since_s = 1e-9 * max(t_ns - self._orientation_ns, 0)
        kept, weight = (
            math.exp(-since_s / SETTINGS.orientation_memory_s),
            min(since_s / SETTINGS.orientation_correlation_s, 1.0) / sigma_rad**2,
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
        if total > SETTINGS.most_mean_nis * max(self._rows, 1.0):
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
        if yaw_sigma > SETTINGS.yaw_rad:
            return None
        aim = m[2:] - N[2:, :2] @ np.array([math.cos(yaw), math.sin(yaw)])
        mounting_known, M = self._K > 0.0, np.eye(3)
        if mounting_known:
            # Now that the foot's axes are known, so is where on the foot the sensor has to be, about.
            M = nearest_rotation(self._summed(np.array([yaw]))[0])
            covariance = np.linalg.inv(N[2:, 2:] + _WORN)
            aim[:3] -= (M @ self._sensor_m) / SETTINGS.worn_m**2
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
