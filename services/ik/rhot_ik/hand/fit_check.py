"""Whether a hand can be what its markers show: residuals of the fingertips that two cameras see.

A hand that fits its markers leaves a millimetre or two. One of the wrong side, or one seen by cameras that all mirror,
leaves 24 to 68 mm: five fingers in the opposite order cannot be reached. Which of the two it is, the markers themselves
do not tell; that the other hand would fit, they do: reflected in a plane, a left hand's markers are a right hand's.
"""

from __future__ import annotations

import dataclasses
from collections import deque
from collections.abc import Callable
from typing import Final

import numpy as np

from rhot.arrays import BoolArray, FloatArray
from rhot.types import Side
from rhot_ik.hand.filter.evidence import HandObservation
from rhot_ik.hand.solver import HandSolver

MISFIT_M: Final = 0.015
"""Mean residual beyond which a hand does not explain what was seen. Of two rendered sequences and ten simulated seconds
no sample exceeds 11 mm; with the wrong side, 99 % of samples exceed 25 mm."""
_TIPS: Final = 2
"""Fewer fingertips can be reached by either hand."""
_SAMPLES: Final = 120
_ENOUGH: Final = 60
"""Samples for a verdict about the rig, of the last `_SAMPLES`: half a second to a second of a hand."""
_REFLECTION: Final = np.array([-1.0, 1.0, 1.0])


def mean_residual_m(residual: FloatArray, two_views: BoolArray) -> float | None:
    """Return the mean residual of the tips that two cameras see, metres; None with fewer than two of them.

    Args:
        residual: (5,) metres; NaN where there is no tip.
        two_views: (5,) which tips two cameras see.
    """
    used = two_views & np.isfinite(residual)
    return float(residual[used].mean()) if np.count_nonzero(used) >= _TIPS else None


class FitCheck:
    """Watches the residuals of one hand.

    Args:
        side: of the hand.
        make_solver: makes a solver of this hand that has seen nothing, for cameras reflected like the markers.
    """

    def __init__(self, side: Side, make_solver: Callable[[], HandSolver]) -> None:
        self._side = side
        self._make_solver = make_solver
        self._recent: deque[tuple[HandObservation, BoolArray, float]] = deque(maxlen=_SAMPLES)
        self._other_m: float | None = None
        self._diagnosed = False

    def add(self, seen: HandObservation, residual: FloatArray, two_views: BoolArray) -> None:
        """Add a sample with its residuals (5,), metres, and which tips (5,) two cameras see."""
        mean = mean_residual_m(residual, two_views)
        if mean is not None:
            self._recent.append((seen, two_views, mean))

    @property
    def problem(self) -> str:
        """What is wrong with the hand as a whole, one sentence; empty when nothing is."""
        if len(self._recent) < _ENOUGH:
            return ""
        usual_m = float(np.median([mean for _, _, mean in self._recent]))
        if usual_m <= MISFIT_M:
            self._diagnosed = False
            return ""
        if not self._diagnosed:
            self._other_m, self._diagnosed = self._residual_of_other_hand(), True
        other: Side = "left" if self._side == "right" else "right"
        told = f"the markers do not fit a {self._side} hand ({1e3 * usual_m:.0f} mm off, 1 to 2 mm are usual)"
        if self._other_m is not None and self._other_m < MISFIT_M:
            return (
                f'{told}, but a {other} one ({1e3 * self._other_m:.1f} mm): if it is one, set hand = "{other}" in '
                "rig.toml; if not, all cameras mirror their pictures: switch mirroring off and calibrate again"
            )
        return (
            f"{told}: are the paints on the fingers that rig.toml names, is hand.json of this person, and do the "
            "cameras stand as they were calibrated?"
        )

    def _residual_of_other_hand(self) -> float | None:
        """Return the median residual that the hand of the other side leaves on the recent samples, metres."""
        solver, means = self._make_solver(), []
        for seen, two_views, _ in self._recent:
            solution = solver.solve(_reflected(seen))
            mean = None if solution is None else mean_residual_m(solution.residual, two_views)
            if mean is not None:
                means.append(mean)
        return float(np.median(means)) if len(means) >= _ENOUGH else None


def reflected_point(point: FloatArray) -> FloatArray:
    """Return points (…, 3), metres, reflected in the plane x = 0."""
    reflected: FloatArray = point * _REFLECTION
    return reflected


def _reflected(seen: HandObservation) -> HandObservation:
    sign = np.outer(_REFLECTION, _REFLECTION)
    return dataclasses.replace(
        seen,
        base=None if seen.base is None else reflected_point(seen.base),
        corners=None if seen.corners is None else reflected_point(seen.corners),
        tips=reflected_point(seen.tips),
        base_covariance=None if seen.base_covariance is None else seen.base_covariance * sign,
        tip_covariances=seen.tip_covariances * sign,
    )
