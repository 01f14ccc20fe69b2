"""How markers move: per marker a bank of Kalman filters that differ in how much acceleration they expect.

Each filter is one of constant velocity driven by white acceleration (Bar-Shalom, Li and Kirubarajan, "Estimation with
Applications to Tracking and Navigation", 2001, section 6.2.2) on the state (position, velocity). The filters of a
marker are weighed by how well they foretold its observations (interacting multiple models, section 11.6.6): a still
hand is averaged over many frames, a fast one is followed at once, and what is learnt sideways, where cameras see well,
decides for the depth too.

Switching goes from any model to the models' shares w, whatever it was before, within `SWITCH_S`:

    π_ij = (1 − e) δ_ij + e w_j,    e = 1 − exp(−dt / SWITCH_S),

so that mixing the filters is a step of each towards the marker's joint estimate, by β_j = e w_j / μ_j.
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
# Covariances of white acceleration: dt³/3 of position, dt²/2 between position and velocity, dt of velocity.
_PARTS: Final = (
    np.array([[1.0, 0.0], [0.0, 0.0]]) / 3.0,
    np.array([[0.0, 1.0], [1.0, 0.0]]) / 2.0,
    np.array([[0.0, 0.0], [0.0, 1.0]]),
)
_GROWTH: FloatArray = np.stack(
    [
        np.concatenate([np.kron(part, np.diag([across, across, along])).ravel() for across, along in DENSITIES])
        for part in _PARTS
    ]
)
"""(3, K · 36) what dt³, dt² and dt add to the covariances."""


@dataclass(frozen=True, slots=True)
class Forecast:
    """What the filters of N markers expect at the moments of their next observations.

    Attributes:
        x: (N, K, 6) positions and velocities, metres and metres per second, rig frame.
        P: (N, K, 6, 6) their covariances.
        weight: (N, K) of the models.
        mean: (N, 6) weighted mean.
        t_s: (N,) the moments.
    """

    x: FloatArray
    P: FloatArray
    weight: FloatArray
    mean: FloatArray
    t_s: FloatArray


@dataclass(frozen=True, slots=True)
class Innovation:
    """How observations differ from what was expected.

    Attributes:
        y: (N, K, 2) innovation under each model, normalised units.
        PHt: (N, K, 6, 2) covariance between state and observation.
        a, b, c: (N, K) entries of the innovation covariance [[a, b], [b, c]].
        d2: (N, K) squared Mahalanobis distance under each model.
        det: (N, K) determinant of the innovation covariance.
    """

    y: FloatArray
    PHt: FloatArray
    a: FloatArray
    b: FloatArray
    c: FloatArray
    d2: FloatArray
    det: FloatArray


class MotionBank:
    """The filters of M markers.

    Attributes:
        mean: (M, 6) joint estimate of position and velocity at `t_s`.
        cov: (M, 6, 6) its covariance.
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
        count = len(company)
        self._company = COMPANY * company
        self._x: FloatArray = np.zeros((count, _MODELS, 6))
        self._P: FloatArray = np.zeros((count, _MODELS, 6, 6))
        self.weight: FloatArray = np.tile(_SHARE, (count, 1))
        self.mean: FloatArray = np.zeros((count, 6))
        self.cov: FloatArray = np.zeros((count, 6, 6))
        self.t_s: FloatArray = np.full(count, -np.inf)

    def clear(self) -> None:
        """Forget all markers."""
        self.t_s[:] = -np.inf
        if self.record is not None:
            self.record.cut(self.t_s)

    def save(self) -> tuple[FloatArray, ...]:
        """Return a copy of everything, for `restore`."""
        return tuple(array.copy() for array in self._arrays())

    def restore(self, saved: tuple[FloatArray, ...]) -> None:
        """Go back to what was saved."""
        for array, old in zip(self._arrays(), saved, strict=True):
            array[...] = old
        if self.record is not None:
            self.record.cut(self.t_s)

    def _arrays(self) -> tuple[FloatArray, ...]:
        return self._x, self._P, self.weight, self.mean, self.cov, self.t_s

    def start(self, index: IndexArray, position: FloatArray, covariance: FloatArray, t_s: float) -> None:
        """Begin markers (N,) at points (N, 3), metres, with covariances (N, 3, 3), at rest."""
        state = np.zeros((len(index), 6))
        state[:, :3] = position
        P = np.zeros((len(index), 6, 6))
        P[:, :3, :3] = covariance
        P[:, 3:, 3:] = _SPEED_SIGMA_M_S**2 * _EYE
        self.mean[index], self.cov[index] = state, P
        self._x[index], self._P[index] = state[:, None], P[:, None]
        self.weight[index] = _SHARE
        self.t_s[index] = t_s
        if self.record is not None:
            self.record.begin(index, t_s, state, P)

    def forecast(self, index: IndexArray, t_s: FloatArray) -> Forecast:
        """Return what is expected of markers (N,) at times (N,); nothing changes."""
        dt = np.maximum(t_s - self.t_s[index], 0.0)
        stay = np.exp(dt * (-1.0 / SWITCH_S))[:, None]
        entering = (1.0 - stay) * _SHARE
        weight = stay * self.weight[index] + entering
        share = (entering / weight)[:, :, None]
        x, P = self._x[index], self._P[index]
        away = self.mean[index][:, None] - x
        P += share[..., None] * (self.cov[index][:, None] - P)
        P += (np.sqrt(share * (1.0 - share)) * away)[..., None] * (np.sqrt(share * (1.0 - share)) * away)[..., None, :]
        x += share * away
        step = dt[:, None, None]
        x[..., :3] += step * x[..., 3:]
        step = step[..., None]
        P[..., :3, :] += step * P[..., 3:, :]
        P[..., :3] += step * P[..., 3:]
        growth = np.stack([dt**3, dt**2, dt], axis=1) @ _GROWTH
        P += growth.reshape(P.shape)
        mean = (weight[:, None, :] @ x)[:, 0]
        return Forecast(x, P, weight, mean, t_s)

    def update(self, index: IndexArray, chosen: NDArray[np.bool_], forecast: Forecast, innovation: Innovation) -> None:
        """Let the chosen (N,) of the observations move their markers (N,)."""
        if not chosen.all():
            index = index[chosen]
            if not len(index):
                return
            forecast = Forecast(*(getattr(forecast, name)[chosen] for name in Forecast.__slots__))
            innovation = Innovation(*(getattr(innovation, name)[chosen] for name in Innovation.__slots__))
        a, b, c, det = innovation.a, innovation.b, innovation.c, innovation.det
        inverse = np.stack([c, -b, -b, a], axis=-1).reshape(*a.shape, 2, 2) / det[..., None, None]
        gain = innovation.PHt @ inverse
        x = forecast.x + (gain @ innovation.y[..., None])[..., 0]
        P = forecast.P - gain @ innovation.PHt.swapaxes(-1, -2)
        evidence = -0.5 * (np.minimum(innovation.d2, _CLEAR_D2) + np.log(det))
        evidence += self._company[np.ix_(index, index)] @ evidence
        weight = forecast.weight * np.exp(evidence - evidence.max(axis=1, keepdims=True))
        weight /= weight.sum(axis=1, keepdims=True)
        mean = (weight[:, None, :] @ x)[:, 0]
        away = x - mean[:, None]
        cov = (weight[:, None, :] @ P.reshape(len(index), _MODELS, 36)).reshape(-1, 6, 6)
        cov += away.swapaxes(1, 2) @ (weight[:, :, None] * away)
        if self.record is not None:
            away = forecast.x - forecast.mean[:, None]
            expected = (forecast.weight[:, None, :] @ forecast.P.reshape(len(index), _MODELS, 36)).reshape(-1, 6, 6)
            expected += away.swapaxes(1, 2) @ (forecast.weight[:, :, None] * away)
            dt = np.maximum(forecast.t_s - self.t_s[index], 0.0)
            self.record.observed(index, forecast.t_s, dt, (forecast.mean, expected), (mean, cov))
        self._x[index], self._P[index], self.weight[index] = x, P, weight
        self.mean[index], self.cov[index], self.t_s[index] = mean, cov, forecast.t_s

    def carry(self, marker: int, step: FloatArray, velocity: FloatArray, spread_m: float, t_s: float) -> None:
        """Move a marker that nobody sees along with its hand.

        Args:
            marker: index.
            step: (3,) metres.
            velocity: (3,) metres per second, from now on.
            spread_m: standard deviation that its place gains along each axis.
            t_s: the moment.
        """
        for state, P in ((self._x[marker], self._P[marker]), (self.mean[marker], self.cov[marker])):
            state[..., :3] += step
            state[..., 3:] = velocity
            P[..., :3, 3:] = 0.0
            P[..., 3:, :3] = 0.0
            P[..., :3, :3] += spread_m**2 * _EYE
            P[..., 3:, 3:] = _SPEED_SIGMA_M_S**2 * _EYE
        self.weight[marker] = _SHARE
        self.t_s[marker] = t_s
        if self.record is not None:
            self.record.carried(marker, t_s, self.mean[marker], self.cov[marker])


def innovate(forecast: Forecast, R: FloatArray, t: FloatArray, xy: FloatArray, variance: FloatArray) -> Innovation:
    """Compare observations with a forecast, to first order about its mean.

    Args:
        forecast: of N markers.
        R: (3, 3) rotates rig directions into the camera frame.
        t: (3,) metres; X_camera = R · X_rig + t.
        xy: (N, 2) observed normalised image coordinates.
        variance: (N, 3) of the observation: of x, of x with y, of y.
    """
    local = forecast.mean[:, :3] @ R.T + t
    # A marker on or behind the image plane has no useful derivative; its innovation refuses it.
    inverse = 1.0 / np.maximum(local[:, 2:], 1e-2)
    projected = local[:, :2] * inverse
    H = (R[:2] - projected[:, :, None] * R[2]) * inverse[:, :, None]
    Ht = H.swapaxes(1, 2)
    y = (xy - projected)[:, None] - (forecast.x[..., :3] - forecast.mean[:, None, :3]) @ Ht
    PHt = forecast.P[..., :3] @ Ht[:, None]
    S = H[:, None] @ PHt[..., :3, :]
    a, b, c = S[..., 0, 0] + variance[:, :1], S[..., 0, 1] + variance[:, 1:2], S[..., 1, 1] + variance[:, 2:]
    det = a * c - b * b
    y0, y1 = y[..., 0], y[..., 1]
    d2 = (c * y0 * y0 - 2.0 * b * y0 * y1 + a * y1 * y1) / det
    return Innovation(y, PHt, a, b, c, d2, det)
