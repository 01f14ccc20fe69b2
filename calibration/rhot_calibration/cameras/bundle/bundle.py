"""Bundle adjustment of cameras, board places and, where asked for, the board's own shape.

Minimised over lenses, camera poses, board poses and corner positions, by Levenberg–Marquardt on the manifold
(Triggs et al., "Bundle Adjustment – A Modern Synthesis", 1999; R ← exp(δω)·R):

    Σ ρ(|uv − project(lens_c, T_camera_rig,c · T_rig_board,p · X_j)| / σ) + Σ ((q − q_prior) / σ_q)²

with Huber's ρ. σ is re-estimated in every step.

The normal equations are summed view by view. On the thesis's chessboards one step of `scipy.optimize.least_squares`,
with the same derivatives, took 35 to 60 ms and a problem 40 steps or more; here a whole problem takes 50 to 100 ms, and
a calibration solves 41 of them. Both found the same focal lengths to 0.1 %.

The corners are released as Strobl and Hirzinger do ("More Accurate Pinhole Camera Calibration with
Imperfect Planar Target", ICCV Workshops 2011), held by priors in place of three fixed corners.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from rhot.arrays import BoolArray, FloatArray
from rhot.errors import CalibrationError
from rhot_calibration.cameras.bundle.equations import HUBER, BundleEquations
from rhot_calibration.cameras.bundle.model import Geometry, Observations, Prior, residuals_of

_MAX_STEPS = 60
_DONE = 1e-6
"""Relative decrease of the cost that ends the descent."""


@dataclass(frozen=True, slots=True)
class Bundle:
    """A solution.

    Attributes:
        geometry: the estimate.
        residuals: (V, N, 2) observed minus projected, pixels; 0 where not seen.
        weights: (V, N) of the last step, 0 to 1.
        sigma_px: standard deviation of a coordinate, from the residuals.
        covariance: (Q, Q) of all parameters: C·9 lenses, (C − 1)·6 camera motions (δω, δt of T_camera_rig), P·6 board
            motions, N·3 corners when released.
    """

    geometry: Geometry
    residuals: FloatArray
    weights: FloatArray
    sigma_px: float
    covariance: FloatArray

    def view_rms(self, seen: BoolArray) -> FloatArray:
        """Return the root mean square (V,) of each view's residuals (distance, pixels); `seen` is (V, N)."""
        squares = np.where(seen, np.sum(self.residuals**2, axis=2), 0.0)
        rms: FloatArray = np.sqrt(squares.sum(axis=1) / np.maximum(seen.sum(axis=1), 1))
        return rms


def adjust(
    geometry: Geometry, observations: Observations, prior: Prior, *, sigma_px: float = 1.0, robust: bool = True
) -> Bundle:
    """Return the geometry that explains the observations best.

    Args:
        geometry: where to start.
        observations: of the board.
        prior: what is known beforehand.
        sigma_px: standard deviation of a coordinate to start with; it is re-estimated in every step.
        robust: weigh large residuals down.

    Raises:
        CalibrationError: the views do not determine the parameters.
    """
    problem = BundleEquations(observations, prior, len(geometry.lenses), len(geometry.board_t))
    damping, sigma = 1e-3, sigma_px
    residuals = residuals_of(geometry, observations)
    weights = _weights(residuals, sigma, robust)
    for _ in range(_MAX_STEPS):
        cost = problem.cost(geometry, residuals, sigma, robust)
        H, g = problem.normal_equations(geometry, weights / sigma**2)
        for _attempt in range(12):
            candidate = problem.moved(geometry, _solve(H + damping * np.diag(np.diag(H)), g))
            moved = residuals_of(candidate, observations)
            new_cost = problem.cost(candidate, moved, sigma, robust)
            if np.isfinite(new_cost) and new_cost <= cost:
                break
            damping *= 6.0
        else:
            break
        geometry, residuals, damping = candidate, moved, max(damping / 8.0, 1e-12)
        settled = abs(problem.sigma(residuals, weights) / sigma - 1.0) < 0.02
        if cost - new_cost < _DONE * cost and settled:
            break
        sigma = problem.sigma(residuals, weights)
        weights = _weights(residuals, sigma, robust)
    weights = _weights(residuals, sigma, robust)
    H, _ = problem.normal_equations(geometry, weights / sigma**2)
    return Bundle(geometry, residuals, weights, sigma, _inverse(H))


def _weights(residuals: FloatArray, sigma: float, robust: bool) -> FloatArray:
    distance = np.linalg.norm(residuals, axis=2)
    if not robust:
        return np.ones_like(distance)
    weights: FloatArray = np.minimum(1.0, HUBER * sigma / np.maximum(distance, 1e-12))
    return weights


def _solve(H: FloatArray, g: FloatArray) -> FloatArray:
    try:
        # Parameters differ by many orders of magnitude; a unit diagonal keeps the factorisation accurate.
        scale = 1.0 / np.sqrt(np.diag(H))
        step: FloatArray = scale * np.linalg.solve(H * np.outer(scale, scale), scale * g)
    except np.linalg.LinAlgError as error:
        raise CalibrationError(_UNDETERMINED) from error
    return step


def _inverse(H: FloatArray) -> FloatArray:
    try:
        scale = 1.0 / np.sqrt(np.diag(H))
        inverse: FloatArray = np.linalg.inv(H * np.outer(scale, scale)) * np.outer(scale, scale)
    except np.linalg.LinAlgError as error:
        raise CalibrationError(_UNDETERMINED) from error
    return inverse


_UNDETERMINED = (
    "the pictures do not determine the cameras; take more, with the board at other places, nearer and farther, and "
    "tilted by 20 to 40 degrees in all directions"
)
