"""How markers move: per marker a bank of Kalman filters that differ in how much acceleration they expect.

Each filter is one of constant velocity driven by white acceleration (Bar-Shalom, Li and Kirubarajan, "Estimation with
Applications to Tracking and Navigation", 2001, section 6.2.2) on the state (position, velocity). The filters of a
marker are weighed by how well they foretold its observations (interacting multiple models, section 11.6.6): a still
hand is averaged over many frames, a fast one is followed at once, and what is learnt sideways, where cameras see well,
decides for the depth too.

Switching goes from any model to the models' shares w, whatever it was before, within `SWITCH_S`:

    π_ij = (1 − e) δ_ij + e w_j,    e = 1 − exp(−dt / SWITCH_S),

so that mixing the filters is a step of each towards the marker's joint estimate, by β_j = e w_j / μ_j.

A handful of markers is little to compute and much to call: the form follows the number of numpy calls. A filter is kept
as the distance d of its mean from the joint estimate under its covariance P, one array of seven rows, so that mixing,
moving, seeing and weighing are one operation on both. Beside it stands its second moment M = P + d d' about the joint
estimate, whose covariance is J = Σ w M; with β the step of mixing, what comes of it is linear in the three:

    P ← (1 − β)² P + β (1 − β) M + β J,    d ← (1 − β) d.

With B and S of `innovation`, a filter's update is (P, d) ← (P, d) − B S⁻¹ (P H')'.

Arrays are replaced and never changed in place: what `save` returns is just them.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from rhot_fusion.filter.innovation import Innovation
from rhot_fusion.filter.path_smoothing import PathRecord

FloatArray = NDArray[np.float64]
IndexArray = NDArray[np.intp]

DENSITIES: Final = ((1e-6, 1e-6), (3e-3, 3e-3), (0.3, 0.3), (1.0, 0.01), (15.0, 15.0))
"""Power spectral density of the acceleration that each model expects, m²/s³, across and along the view of the first
camera: at rest, slow, brisk, brisk across the view alone, fast."""
SHARES: Final = (0.25, 0.25, 0.15, 0.25, 0.1)
SWITCH_S: Final = 0.25

COMPANY: Final = 0.3
"""What the other markers of a hand tell of a marker's model, as a share of what its own observation does."""
_CLEAR_D2: Final = 30.0

_SPEED_SIGMA_M_S: Final = 0.5
"""Of a marker that has just been found."""
_MODELS: Final = len(DENSITIES)
_SHARE: FloatArray = np.array(SHARES)
_EYE: FloatArray = np.eye(3)
_STAY: FloatArray = np.eye(7)
_DRIFT: FloatArray = np.diag([1.0, 1.0, 1.0, 0.0], 3)
"""A filter X of seven rows moves on to F X G', with F = _STAY + dt · _DRIFT and G its first six rows and columns."""
_TURNED: IndexArray = np.array([3, 1, 1, 0])
_ADJUGATE: FloatArray = np.array([1.0, -1.0, -1.0, 1.0])
"""The inverse of [[a, b], [b, c]] is its entries in this order with these signs over the determinant."""
_SUM: FloatArray = np.ones((_MODELS, 1))
_PAIR: FloatArray = np.ones(2)
_AWAY: Final = 6
"""The row of a filter that holds its mean; the rows before are its covariance."""
_ENTRIES: Final = 42
_ROWS: Final = 2 * _MODELS + 1
# Covariances of white acceleration: dt³/3 of position, dt²/2 between position and velocity, dt of velocity.
_POWERS: FloatArray = np.array([3.0, 2.0, 1.0])
_PARTS: Final = (
    np.array([[1.0, 0.0], [0.0, 0.0]]) / 3.0,
    np.array([[0.0, 1.0], [1.0, 0.0]]) / 2.0,
    np.array([[0.0, 0.0], [0.0, 1.0]]),
)
_NOWHERE: Final = [0.0] * 6
_GROWTH: FloatArray = np.stack(
    [
        np.concatenate(
            [[*np.kron(part, np.diag([across, across, along])).ravel(), *_NOWHERE] for across, along in DENSITIES]
        )
        for part in _PARTS
    ]
)
"""(3, K · 42) what dt³, dt² and dt add to the filters."""


@dataclass(frozen=True, slots=True)
class Forecast:
    """What the filters of N markers expect at the moments of their next observations.

    Attributes:
        filters: (N, K, 7, 6) covariances, metres and metres per second, and in the last row each mean less the joint.
        weight: (N, K) of the models.
        mean: (N, 6) joint positions and velocities, rig frame.
        t_s: (N,) the moments.
    """

    filters: FloatArray
    weight: FloatArray
    mean: FloatArray
    t_s: FloatArray

    @property
    def P(self) -> FloatArray:
        """(N, K, 6, 6) covariances."""
        return self.filters[:, :, :_AWAY]

    @property
    def away(self) -> FloatArray:
        """(N, K, 6) means less the joint one."""
        return self.filters[:, :, _AWAY]

    def of(self, chosen: NDArray[np.bool_]) -> Forecast:
        """Return the same of the chosen (N,) markers."""
        return Forecast(self.filters[chosen], self.weight[chosen], self.mean[chosen], self.t_s[chosen])


class MotionBank:
    """The filters of M markers.

    Attributes:
        mean: (M, 6) joint estimate of position and velocity at `t_s`.
        weight: (M, K) of the models.
        t_s: (M,) time of each marker's last observation.
        record: what the filters did, when it is kept.
    """

    def __init__(self, company: FloatArray, record: PathRecord | None = None) -> None:
        """Begin without markers.

        Args:
            company: (M, M) 1 where two markers are on one hand, 0 elsewhere and on the diagonal.
            record: takes what the filters do.
        """
        self.record = record
        self._count = len(company)
        # What a marker's own surprise and that of the others tell of its model; the log of a likelihood is −½ of it.
        self._company: FloatArray = -0.5 * (np.eye(self._count) + COMPANY * company)
        # The filters' P and d, their M and d, and J: (M, 2 K + 1, 7, 6).
        self._moments: FloatArray = np.zeros((self._count, _ROWS, _AWAY + 1, 6))
        self.weight: FloatArray = np.tile(_SHARE, (self._count, 1))
        self.mean: FloatArray = np.zeros((self._count, 6))
        self.t_s: FloatArray = np.full(self._count, -np.inf)

    @property
    def cov(self) -> FloatArray:
        """(M, 6, 6) covariance of the joint estimate."""
        return self._moments[:, -1, :_AWAY]

    @property
    def variances(self) -> FloatArray:
        """(M, 6) diagonals of `cov`."""
        return self._moments.reshape(self._count, _ROWS, _ENTRIES)[:, -1, : _AWAY * 6 : _AWAY + 1]

    def clear(self) -> None:
        """Forget all markers."""
        self.t_s = np.full(self._count, -np.inf)
        if self.record is not None:
            self.record.cut(self.t_s)

    def save(self) -> tuple[FloatArray, ...]:
        """Return everything, for `restore`."""
        return self._moments, self.weight, self.mean, self.t_s

    def restore(self, saved: tuple[FloatArray, ...]) -> None:
        """Go back to what was saved."""
        self._moments, self.weight, self.mean, self.t_s = saved
        if self.record is not None:
            self.record.cut(self.t_s)

    def _replace(
        self, rows: IndexArray | slice, moments: FloatArray, weight: FloatArray, mean: FloatArray, t_s: FloatArray
    ) -> None:
        """Put new arrays in the place of the old, with these rows changed."""
        new = moments, weight, mean, t_s
        if not isinstance(rows, slice):
            old = [array.copy() for array in self.save()]
            for array, changed in zip(old, new, strict=True):
                array[rows] = changed
            new = old[0], old[1], old[2], old[3]
        self._moments, self.weight, self.mean, self.t_s = new

    def _rows(self, index: IndexArray) -> IndexArray | slice:
        """Return what selects markers (N,), ascending; all of them without a copy."""
        return slice(None) if len(index) == self._count else index

    def start(self, index: IndexArray, position: FloatArray, covariance: FloatArray, t_s: float) -> None:
        """Begin markers (N,) at points (N, 3), metres, with covariances (N, 3, 3), at rest."""
        count = len(index)
        state = np.zeros((count, 6))
        state[:, :3] = position
        moments = np.zeros((count, _ROWS, _AWAY + 1, 6))
        moments[:, :, :3, :3] = covariance[:, None]
        moments[:, :, 3:_AWAY, 3:] = _SPEED_SIGMA_M_S**2 * _EYE
        self._replace(index, moments, np.tile(_SHARE, (count, 1)), state, np.full(count, t_s))
        if self.record is not None:
            self.record.begin(index, t_s, state, moments[:, -1, :_AWAY])

    def forecast(self, index: IndexArray, t_s: FloatArray) -> Forecast:
        """Return what is expected of markers (N,), ascending, at times (N,); nothing changes."""
        rows, count = self._rows(index), len(index)
        dt = np.maximum(t_s - self.t_s[rows], 0.0)[:, None]
        stay = np.exp(dt * (-1.0 / SWITCH_S))
        entering = (1.0 - stay) * _SHARE
        weight = stay * self.weight[rows]
        weight += entering
        share = entering / weight
        keep = 1.0 - share
        mixing = np.zeros((count, _MODELS * _ROWS))
        mixing[:, :: _ROWS + 1] = keep * keep
        mixing[:, _MODELS :: _ROWS + 1] = share * keep
        mixing[:, _ROWS - 1 :: _ROWS] = share
        filters = mixing.reshape(count, _MODELS, _ROWS) @ self._moments[rows].reshape(count, _ROWS, _ENTRIES)
        filters = filters.reshape(count, _MODELS, _AWAY + 1, 6)
        move = _STAY + dt[:, :, None] * _DRIFT
        moved = move.swapaxes(1, 2)[:, None, :_AWAY, :_AWAY]
        filters = move[:, None] @ filters @ moved
        filters += (dt**_POWERS @ _GROWTH).reshape(filters.shape)
        mean = (self.mean[rows][:, None] @ moved[:, 0])[:, 0]
        return Forecast(filters, weight, mean, t_s)

    def update(self, index: IndexArray, chosen: NDArray[np.bool_], forecast: Forecast, innovation: Innovation) -> None:
        """Let the chosen (N,) of the observations move their markers (N,), ascending."""
        if np.count_nonzero(chosen) < len(chosen):
            index = index[chosen]
            if not len(index):
                return
            forecast, innovation = forecast.of(chosen), innovation.of(chosen)
        B, S, det, rows, count = innovation.B, innovation.S, innovation.det, self._rows(index), len(index)
        # The same entry for both off the diagonal: the exact inverse would feed what rounding makes unlike in them.
        inverse = S.reshape(count, _MODELS, 4).take(_TURNED, axis=2) * (_ADJUGATE / det[:, :, None])
        gain = B @ inverse.reshape(S.shape)
        # The innovation's squared Mahalanobis distance.
        distance2 = (gain[:, :, _AWAY] * B[:, :, _AWAY]) @ _PAIR
        surprise = np.minimum(distance2, _CLEAR_D2) + np.log(det)
        company = self._company if isinstance(rows, slice) else self._company[index[:, None], index]
        evidence = company @ surprise
        # Bounded by _CLEAR_D2: against any one of the models nothing overflows.
        weight = forecast.weight * np.exp(evidence - evidence[:, :1])
        weight /= weight @ _SUM
        moments = np.empty((count, _ROWS, _AWAY + 1, 6))
        filters, seconds = moments[:, :_MODELS], moments[:, _MODELS:-1]
        # A product of views that are not contiguous takes five times as long.
        np.subtract(forecast.filters, gain @ np.ascontiguousarray(B[:, :, :_AWAY].swapaxes(2, 3)), out=filters)
        away = np.zeros((count, _MODELS, _AWAY + 1))
        away[:, :, :_AWAY] = filters[:, :, _AWAY]
        step = weight[:, None] @ away
        away -= step
        filters[:, :, _AWAY] = row = away[:, :, :_AWAY]
        # The last entry of d is 0: the last row of the second moments is that of the filters.
        np.matmul(away[:, :, :, None], row[:, :, None], out=seconds)
        seconds += filters
        flat = moments.reshape(count, _ROWS, _ENTRIES)
        np.matmul(weight[:, None], flat[:, _MODELS:-1], out=flat[:, -1:])
        mean = forecast.mean + step[:, 0, :_AWAY]
        if self.record is not None:
            expected = (forecast.weight[:, None] @ forecast.filters.reshape(count, _MODELS, _ENTRIES))[:, 0]
            expected = expected.reshape(count, _AWAY + 1, 6)[:, :_AWAY] + _scatter(forecast.weight, forecast.away)
            dt = np.maximum(forecast.t_s - self.t_s[rows], 0.0)
            self.record.observed(index, forecast.t_s, dt, (forecast.mean, expected), (mean, moments[:, -1, :_AWAY]))
        self._replace(rows, moments, weight, mean, forecast.t_s)

    def carry(self, marker: int, step: FloatArray, velocity: FloatArray, spread_m: float, t_s: float) -> None:
        """Move a marker that nobody sees along with its hand.

        Args:
            marker: index.
            step: (3,) metres.
            velocity: (3,) metres per second, from now on.
            spread_m: standard deviation that its place gains along each axis.
            t_s: the moment.
        """
        moments, mean = self._moments[marker].copy(), self.mean[marker].copy()
        mean[:3] += step
        mean[3:] = velocity
        # About one mean, the second moments are the covariances.
        moments[_MODELS:-1] = moments[:_MODELS]
        moments[:, _AWAY] = 0.0
        moments[:, :3, 3:] = 0.0
        moments[:, 3:_AWAY, :3] = 0.0
        moments[:, :3, :3] += spread_m**2 * _EYE
        moments[:, 3:_AWAY, 3:] = _SPEED_SIGMA_M_S**2 * _EYE
        one = np.array([marker])
        self._replace(one, moments, _SHARE, mean, np.full(1, t_s))
        if self.record is not None:
            self.record.carried(marker, t_s, mean, moments[-1, :_AWAY])


def _scatter(weight: FloatArray, away: FloatArray) -> FloatArray:
    """Return Σ w d d' (N, 6, 6) over the models (N, K, 6)."""
    scatter: FloatArray = (weight[:, :, None] * away).swapaxes(1, 2) @ away
    return scatter
