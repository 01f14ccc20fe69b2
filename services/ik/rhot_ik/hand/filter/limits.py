"""Joint limits as inequality constraints on the estimate.

The estimate is projected onto the limits in the metric of P (Simon & Chia 2002): an angle that is beyond is set to its
limit, and all others are moved by what that says about them. That the angle is at its limit is not known, only that it
is not beyond: of the normal distribution about the estimate the part inside is left (Simon & Simon 2010), and its mean
square from the limit is the variance that the angle keeps. Without it a straight finger counts as known for certain.
"""

from __future__ import annotations

from typing import Final

import numpy as np

from rhot.arrays import FloatArray
from rhot_ik.hand.filter.process import ANGLES

_BEYOND_RAD: Final = 1e-6
_MOST_ROUNDS: Final = 3
_LEAST: Final = 1e-6
"""Square radians, for what the limits of two angles at once leave singular."""
_SHARE: Final = (0.74, 0.365)
"""Of 1 / (1 + a·c + b·c²), the mean square from its limit of an angle that is c standard deviations beyond, in units of
its variance: exactly 1 + c² − c·φ(c)/Q(c), which is 0.475, 0.254 and 0.150 at c = 1, 2 and 3."""


def within_limits(
    dx: FloatArray, P: FloatArray, angles: FloatArray, low: FloatArray, high: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Return the errors (43,) of a state constrained to the joint limits, and their covariance (43, 43).

    Args:
        dx: (43,) errors of a state, see `rhot_ik.hand.filter.process`.
        P: (43, 43) covariance about them.
        angles: (20,) radians, of the state.
        low, high: (20,) radians.
    """
    for _ in range(_MOST_ROUNDS):
        q = angles + dx[ANGLES]
        over = np.minimum(np.maximum(q, low), high) - q
        bad = np.flatnonzero(np.abs(over) > _BEYOND_RAD)
        if not len(bad):
            break
        columns = P[:, ANGLES.start + bad]
        own = columns[ANGLES.start + bad]
        variances = own.diagonal() + _LEAST
        if len(bad) == 1:
            gain: FloatArray = columns.T / variances
        elif len(bad) == 2:
            # The most usual case by far (a last hinge goes with its middle one), and half of the cost that way.
            (_, b), (a, c) = own[0].tolist(), variances.tolist()
            gain = np.array([[c, -b], [-b, a]]) / (a * c - b * b) @ columns.T
        else:
            gain = np.asarray(np.linalg.solve(own + _LEAST * np.eye(len(bad)), columns.T), dtype=np.float64)
        beyond = np.abs(over[bad]) / np.sqrt(variances)
        kept = 1.0 / np.sqrt(1.0 + (_SHARE[0] + _SHARE[1] * beyond) * beyond)
        left = own - kept[:, None] * own * kept
        dx, P = dx + over[bad] @ gain, P - gain.T @ left @ gain
    return dx, P
