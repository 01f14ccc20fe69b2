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
moving, seeing and weighing are one operation on both. With H the derivative of an observation and r its distance from
what the joint estimate foretells, B = (P H', d H' − r), a filter's update is

    (P, d) ← (P, d) − B S⁻¹ (P H')'.

Arrays are replaced and never changed in place: what `save` returns is just them.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from rhot_fusion.path_smoothing import PathRecord

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
_STAY: FloatArray = np.eye(6)
_DRIFT: FloatArray = np.kron(np.array([[0.0, 0.0], [1.0, 0.0]]), _EYE)
"""A row of a state or covariance moves on by its product with _STAY + dt · _DRIFT."""
_TURNED: IndexArray = np.array([3, 1, 1, 0])
_ADJUGATE: FloatArray = np.array([1.0, -1.0, -1.0, 1.0])
"""The inverse of [[a, b], [b, c]] is its entries in this order with these signs over the determinant."""
_SUM: FloatArray = np.ones((_MODELS, 1))
_AWAY: Final = 6
"""The row of a filter that holds its mean; the rows before are its covariance."""
_ENTRIES: Final = 42
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


@dataclass(frozen=True, slots=True)
class Innovation:
    """How observations differ from what was expected.

    Attributes:
        y: (N, 2) innovation, the models together, normalised units.
        B: (N, K, 7, 2) covariance between state and observation; in the last row the innovation's negative.
        S: (N, K, 2, 2) innovation covariance.
        det: (N, K) its determinant.
    """

    y: FloatArray
    B: FloatArray
    S: FloatArray
    det: FloatArray


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
        self._filters: FloatArray = np.zeros((self._count, _MODELS, _AWAY + 1, 6))
        self._joint: FloatArray = np.zeros((self._count, _AWAY + 1, 6))
        self.weight: FloatArray = np.tile(_SHARE, (self._count, 1))
        self.mean: FloatArray = np.zeros((self._count, 6))
        self.t_s: FloatArray = np.full(self._count, -np.inf)

    @property
    def cov(self) -> FloatArray:
        """(M, 6, 6) covariance of the joint estimate."""
        return self._joint[:, :_AWAY]

    @property
    def variances(self) -> FloatArray:
        """(M, 6) diagonals of `cov`."""
        return self._joint.reshape(self._count, _ENTRIES)[:, : _AWAY * 6 : _AWAY + 1]

    def clear(self) -> None:
        """Forget all markers."""
        self.t_s = np.full(self._count, -np.inf)
        if self.record is not None:
            self.record.cut(self.t_s)

    def save(self) -> tuple[FloatArray, ...]:
        """Return everything, for `restore`."""
        return self._filters, self._joint, self.weight, self.mean, self.t_s

    def restore(self, saved: tuple[FloatArray, ...]) -> None:
        """Go back to what was saved."""
        self._filters, self._joint, self.weight, self.mean, self.t_s = saved
        if self.record is not None:
            self.record.cut(self.t_s)

    def _replace(
        self,
        rows: IndexArray | slice,
        filters: FloatArray,
        joint: FloatArray,
        weight: FloatArray,
        mean: FloatArray,
        t_s: FloatArray,
    ) -> None:
        """Put new arrays in the place of the old, with these rows changed."""
        new = filters, joint, weight, mean, t_s
        if isinstance(rows, slice):
            self._filters, self._joint, self.weight, self.mean, self.t_s = new
            return
        old = [array.copy() for array in self.save()]
        for array, changed in zip(old, new, strict=True):
            array[rows] = changed
        self._filters, self._joint, self.weight, self.mean, self.t_s = old

    def _rows(self, index: IndexArray) -> IndexArray | slice:
        """Return what selects markers (N,), ascending; all of them without a copy."""
        return slice(None) if len(index) == self._count else index

    def start(self, index: IndexArray, position: FloatArray, covariance: FloatArray, t_s: float) -> None:
        """Begin markers (N,) at points (N, 3), metres, with covariances (N, 3, 3), at rest."""
        count = len(index)
        state = np.zeros((count, 6))
        state[:, :3] = position
        joint = np.zeros((count, _AWAY + 1, 6))
        joint[:, :3, :3] = covariance
        joint[:, 3:_AWAY, 3:] = _SPEED_SIGMA_M_S**2 * _EYE
        filters = np.repeat(joint[:, None], _MODELS, axis=1)
        self._replace(index, filters, joint, np.tile(_SHARE, (count, 1)), state, np.full(count, t_s))
        if self.record is not None:
            self.record.begin(index, t_s, state, joint[:, :_AWAY])

    def forecast(self, index: IndexArray, t_s: FloatArray) -> Forecast:
        """Return what is expected of markers (N,), ascending, at times (N,); nothing changes."""
        rows, count = self._rows(index), len(index)
        dt = np.maximum(t_s - self.t_s[rows], 0.0)
        stay = np.exp(dt * (-1.0 / SWITCH_S))[:, None]
        entering = (1.0 - stay) * _SHARE
        weight = stay * self.weight[rows]
        weight += entering
        share = (entering / weight)[:, :, None]
        before = self._filters[rows]
        away = before[:, :, _AWAY] * np.sqrt(share - share * share)
        filters = self._joint[rows][:, None] - before
        filters *= share[:, :, :, None]
        filters += before
        filters[:, :, :_AWAY] += away[:, :, :, None] @ away[:, :, None]
        dt = dt[:, None, None]
        filters = filters.reshape(count, _MODELS * (_AWAY + 1), 6) @ (_STAY + dt * _DRIFT)
        filters = filters.reshape(count, _MODELS, _ENTRIES)
        filters[:, :, :18] += dt * filters[:, :, 18:36]
        filters += (dt[:, 0] ** _POWERS @ _GROWTH).reshape(filters.shape)
        mean = self.mean[rows].copy()
        mean[:, :3] += dt[:, 0] * mean[:, 3:]
        return Forecast(filters.reshape(count, _MODELS, _AWAY + 1, 6), weight, mean, t_s)

    def update(self, index: IndexArray, chosen: NDArray[np.bool_], forecast: Forecast, innovation: Innovation) -> None:
        """Let the chosen (N,) of the observations move their markers (N,), ascending."""
        if not chosen.all():
            index = index[chosen]
            if not len(index):
                return
            forecast = Forecast(*(getattr(forecast, name)[chosen] for name in Forecast.__slots__))
            innovation = Innovation(*(getattr(innovation, name)[chosen] for name in Innovation.__slots__))
        B, S, det, rows, count = innovation.B, innovation.S, innovation.det, self._rows(index), len(index)
        # The same entry for both off the diagonal: the exact inverse would feed what rounding makes unlike in them.
        inverse = S.reshape(count, _MODELS, 4).take(_TURNED, axis=2) * (_ADJUGATE / det[:, :, None])
        inverse = inverse.reshape(S.shape)
        # A product of views that are not contiguous takes five times as long.
        taken = B @ inverse @ np.ascontiguousarray(B.swapaxes(2, 3))
        filters = forecast.filters - taken[:, :, :, :_AWAY]
        # The last entry is the squared Mahalanobis distance.
        surprise = np.minimum(taken[:, :, _AWAY, _AWAY], _CLEAR_D2) + np.log(det)
        company = self._company if isinstance(rows, slice) else self._company[index[:, None], index]
        evidence = company @ surprise
        # Bounded by _CLEAR_D2: against any one of the models nothing overflows.
        weight = forecast.weight * np.exp(evidence - evidence[:, :1])
        weight /= weight @ _SUM
        joint = (weight[:, None] @ filters.reshape(count, _MODELS, _ENTRIES)).reshape(count, _AWAY + 1, 6)
        mean = forecast.mean + joint[:, _AWAY]
        filters[:, :, _AWAY] -= joint[:, _AWAY, None]
        joint[:, _AWAY] = 0.0
        joint[:, :_AWAY] += _scatter(weight, filters)
        if self.record is not None:
            expected = (forecast.weight[:, None] @ forecast.filters.reshape(count, _MODELS, _ENTRIES))[:, 0]
            expected = expected.reshape(count, _AWAY + 1, 6)[:, :_AWAY] + _scatter(forecast.weight, forecast.filters)
            dt = np.maximum(forecast.t_s - self.t_s[rows], 0.0)
            self.record.observed(index, forecast.t_s, dt, (forecast.mean, expected), (mean, joint[:, :_AWAY]))
        self._replace(rows, filters, joint, weight, mean, forecast.t_s)

    def carry(self, marker: int, step: FloatArray, velocity: FloatArray, spread_m: float, t_s: float) -> None:
        """Move a marker that nobody sees along with its hand.

        Args:
            marker: index.
            step: (3,) metres.
            velocity: (3,) metres per second, from now on.
            spread_m: standard deviation that its place gains along each axis.
            t_s: the moment.
        """
        filters, joint, mean = self._filters[marker].copy(), self._joint[marker].copy(), self.mean[marker].copy()
        mean[:3] += step
        mean[3:] = velocity
        filters[:, _AWAY] = 0.0
        for P in (filters[:, :_AWAY], joint[:_AWAY]):
            P[..., :3, 3:] = 0.0
            P[..., 3:, :3] = 0.0
            P[..., :3, :3] += spread_m**2 * _EYE
            P[..., 3:, 3:] = _SPEED_SIGMA_M_S**2 * _EYE
        one = np.array([marker])
        self._replace(one, filters, joint, _SHARE, mean, np.full(1, t_s))
        if self.record is not None:
            self.record.carried(marker, t_s, mean, joint[:_AWAY])


def _scatter(weight: FloatArray, filters: FloatArray) -> FloatArray:
    """Return Σ w d d' (N, 6, 6) over the models."""
    away = np.ascontiguousarray(filters[:, :, _AWAY])
    scatter: FloatArray = np.ascontiguousarray((weight[:, :, None] * away).swapaxes(1, 2)) @ away
    return scatter


def innovate(forecast: Forecast, R: FloatArray, t: FloatArray, xy: FloatArray, variance: FloatArray) -> Innovation:
    """Compare observations with a forecast, to first order about its mean.

    Args:
        forecast: of N markers.
        R: (3, 3) rotates rig directions into the camera frame.
        t: (3,) metres; X_camera = R · X_rig + t.
        xy: (N, 2) observed normalised image coordinates.
        variance: (N, 2, 2) of the observation.
    """
    count = len(xy)
    local = forecast.mean[:, :3] @ R.T + t
    # A marker on or behind the image plane has no useful derivative; its innovation refuses it.
    inverse = 1.0 / np.maximum(local[:, 2:], 1e-2)
    projected = local[:, :2] * inverse
    y = xy - projected
    H = (R[:2] - projected[:, :, None] * R[2]) * inverse[:, :, None]
    Ht = np.ascontiguousarray(H.swapaxes(1, 2))
    B = (forecast.filters.reshape(count, _MODELS * (_AWAY + 1), 6)[:, :, :3] @ Ht).reshape(count, _MODELS, _AWAY + 1, 2)
    B[:, :, _AWAY] -= y[:, None]
    S = H[:, None] @ B[:, :, :3]
    S += variance[:, None]
    a, b, _, c = S.reshape(count, _MODELS, 4).transpose(2, 0, 1)
    return Innovation(y, B, S, a * c - b * b)
