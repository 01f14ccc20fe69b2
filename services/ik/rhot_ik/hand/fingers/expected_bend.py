"""How far a nearly straight finger is bent: the mean of what its reach leaves open, not the likeliest.

Near the straight finger the distance from knuckle to marker hardly changes with the bend: 2 mm of error are 20°. The
filter's answer is the likeliest one, and of a reach that errs long that is a finger quite straight, its knuckle bent
instead. The mean over all bends θ that explain the reach r,

    E[θ | r] = ∫ θ·p(r | θ)·p(θ) dθ / ∫ p(r | θ)·p(θ) dθ,   p(r | θ) = N(r − r(θ); 0, REACH_SIGMA_M²),

has the least expected square of error. p(θ) is the one of `rhot_ik.hand.filter.prior` within the limits. Both hinges
follow it, and the knuckle turns back by as much as keeps the marker's direction.
"""

from __future__ import annotations

from typing import Final

import numpy as np

from rhot.arrays import FloatArray
from rhot_ik.hand.filter.prior import angle_covariance, rest_angles
from rhot_ik.hand.fingers.closed_form import AnalyticFingers

REACH_SIGMA_M: Final = 0.002
"""Error of the distance from knuckle to marker: what is seen of a painted tip wanders along the finger by as much."""
_NODES: Final = 64
_FLEXION: Final = 0
_MIDDLE: Final = 2


class ExpectedBend:
    """Tables of one hand, from the likeliest bend of each finger to the mean; stateless after construction.

    Args:
        fingers: its closed form.
    """

    def __init__(self, fingers: AnalyticFingers) -> None:
        model = fingers.model
        self._low, self._high = model.angle_min, model.angle_max
        bends = np.linspace(self._low[:, _MIDDLE], self._high[:, _MIDDLE], _NODES, axis=-1)
        reach, direction = fingers.reach(bends)
        rest = rest_angles(model).reshape(5, 4)[:, _MIDDLE, None]
        spread = np.sqrt(np.diag(angle_covariance(model)).reshape(5, 4)[:, _MIDDLE, None])
        off = (reach[:, None, :] - reach[:, :, None]) / REACH_SIGMA_M
        weights = np.exp(-0.5 * (off * off + (((bends - rest) / spread) ** 2)[:, None, :]))
        mean = (weights * bends[:, None, :]).sum(-1) / weights.sum(-1)
        # What is added to flexion, middle and last hinge.
        self._corrections = np.zeros((5, _NODES, 4))
        self._corrections[:, :, _FLEXION] = direction - fingers.reach(mean)[1]
        self._corrections[:, :, _MIDDLE] = mean - bends
        self._corrections[:, :, 3] = fingers.last_hinge(mean) - fingers.last_hinge(bends)
        self._per_radian = (_NODES - 1) / (self._high[:, _MIDDLE] - self._low[:, _MIDDLE])
        self._slopes = np.diff(self._corrections, axis=1)
        self._rows = np.arange(5)

    def expected(self, angles: FloatArray) -> FloatArray:
        """Return the expected angles (5, 4) of the likeliest ones (5, 4), radians, both inside the limits."""
        position = (angles[:, _MIDDLE] - self._low[:, _MIDDLE]) * self._per_radian
        index = np.minimum(position, _NODES - 1.001).astype(np.intp)
        part = (position - index)[:, None] * self._slopes[self._rows, index]
        expected = angles + self._corrections[self._rows, index] + part
        clamped: FloatArray = np.minimum(np.maximum(expected, self._low), self._high)
        return clamped
