"""The most probable hand, by least squares over few parameters, and what it leaves uncertain."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy.optimize import least_squares

from rhot.arrays import FloatArray
from rhot_calibration.hand.fit.parameters import BONE_SD, PRIOR_SD, TYPED_SD_M, HandParameters

Residuals = Callable[[FloatArray], FloatArray]


@dataclass(frozen=True, slots=True)
class HandFit:
    """The fitted hand.

    Attributes:
        x: (COUNT,) parameters.
        covariance: (COUNT, COUNT) of them, as the assumed noise has it.
    """

    x: FloatArray
    covariance: FloatArray


def fit(evidence: Residuals, parameters: HandParameters, x: FloatArray, typed_length_m: float | None) -> HandFit:
    """Return the maximum of the posterior near a start; its covariance is that of the linearised problem.

    Args:
        evidence: residuals in standard deviations at parameters (COUNT,).
        parameters: what is unknown of the hand.
        x: (COUNT,) to start from.
        typed_length_m: the hand's length as somebody measured it, where known.
    """

    def residuals(scores: FloatArray) -> FloatArray:
        trial = scores * PRIOR_SD
        shape = parameters.shape(trial)
        believed = [*scores, shape.middle_metacarpal / BONE_SD]
        if typed_length_m is not None:
            believed.append((shape.length - typed_length_m) / TYPED_SD_M)
        return np.concatenate([evidence(trial), believed])

    most_calls = 25
    found = least_squares(residuals, x / PRIOR_SD, xtol=1e-5, ftol=1e-4, max_nfev=most_calls)
    J = np.asarray(found.jac, dtype=np.float64)
    covariance = np.linalg.inv(J.T @ J) * PRIOR_SD * PRIOR_SD[:, None]
    return HandFit(np.asarray(found.x * PRIOR_SD), np.asarray(covariance))
