"""A square's orientation through time, without any other sensor: several hypotheses, each with its own past.

In every picture each of the two poses may be the right one. A hypothesis is a sequence of such choices; it holds an
orientation and an angular velocity with their covariance (a Kalman filter about the camera's axes), the sum of what
spoke for and against it, and the direction in which its marker has mostly looked. The wrong sequence betrays itself
sooner or later: its pictures fit worse, it turns when the marker only moves (the mirrored pose depends on the line of
sight), or it has to jump. Hypotheses that have become alike are merged, unlikely ones dropped.

Model: angular acceleration is white noise, angular velocity dies away, R' = exp([ω·Δt]×) · R.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from rhot.geometry.rotations import quaternion_from_rotation, rotation_cosine, rotation_from_vector
from rhot_feet.marker.pose import MarkerPose

FloatArray = NDArray[np.float64]

_ACCELERATION: Final = 8.0
"""Root of the spectral density of the angular acceleration, rad/s^1.5: hands and feet."""
_DECAY_S: Final = 0.15
_FLOOR_RAD: Final = float(np.radians(2.0))
"""What no reprojection error shows: bowed paper, lens, size."""
_MAX_DISTANCE: Final = 24.0
"""A squared Mahalanobis distance counts for no more; measurements farther out pull as if they were so far."""
_MAX_EVIDENCE: Final = 3.0
"""One picture says no more than this about its two poses, in log-likelihood: its corners share their errors."""
_FACING_WEIGHT: Final = 60.0
"""Log-likelihood lost per second and square radian away from where the marker has looked lately."""
_FACING_S: Final = 2.0
_HYPOTHESES: Final = 6
_MERGE_COSINE: Final = float(np.cos(np.radians(4.0)))
_DROP: Final = 15.0
_MAX_GAP_S: Final = 0.5
_FIRST_RATE: Final = 2.0
"""Standard deviation of the angular velocity of a marker that has just appeared, rad/s."""


@dataclass(frozen=True, slots=True)
class _Hypotheses:
    """N hypotheses, the likeliest first.

    Attributes:
        t_s: time of the newest picture.
        R: (N, 3, 3).
        rate: (N, 3) angular velocity, rad/s, camera axes.
        P: (N, 6, 6) covariance of rotation and rate.
        weight: (N,) log-likelihood, 0 for the best.
        facing: (N, 3) mean of the marker's normal.
    """

    t_s: float
    R: FloatArray
    rate: FloatArray
    P: FloatArray
    weight: FloatArray
    facing: FloatArray


class OrientationTrack:
    """Follows the orientation of one marker."""

    def __init__(self) -> None:
        self._state: _Hypotheses | None = None

    def reset(self) -> None:
        """Forget everything: the marker was gone for long."""
        self._state = None

    @property
    def orientation(self) -> FloatArray | None:
        """(3, 3) filtered orientation of the likeliest hypothesis; None before the first picture."""
        return None if self._state is None else self._state.R[0]

    @property
    def margin(self) -> float:
        """Difference of −2·log-likelihood between the two likeliest hypotheses; infinite when one is left."""
        if self._state is None:
            return 0.0
        return float("inf") if len(self._state.weight) == 1 else float(-2.0 * self._state.weight[1])

    def update(self, t_s: float, poses: Sequence[MarkerPose]) -> int:
        """Update with the poses of one picture and return the index of the one to believe, see `nearest`.

        Args:
            t_s: time, seconds; later than the picture before.
            poses: at least one.
        """
        R = np.stack([pose.R_camera_marker for pose in poses])
        noise = np.stack([pose.covariance[:3, :3] for pose in poses]) + _FLOOR_RAD**2 * np.eye(3)
        costs = np.array([pose.cost for pose in poses])
        evidence = np.maximum(-0.5 * (costs - costs.min()), -_MAX_EVIDENCE)
        if self._state is None:
            self._state = _first(t_s, R, noise, evidence)
        else:
            self._state = _updated(_predicted(self._state, t_s), self._state.t_s, R, noise, evidence)
        return self.nearest(R)

    def nearest(self, R: FloatArray) -> int:
        """Return to which of orientations (M, 3, 3) most of the belief lies nearest; 0 before the first picture.

        That need not be the one nearest to the likeliest hypothesis: several others may outweigh it together.
        """
        if self._state is None:
            return 0
        nearest = np.argmax(np.einsum("nij,mij->nm", self._state.R, R), axis=1)
        return int(np.argmax(np.bincount(nearest, weights=np.exp(self._state.weight), minlength=len(R))))


def _first(t_s: float, R: FloatArray, noise: FloatArray, evidence: FloatArray) -> _Hypotheses:
    order = np.argsort(-evidence)
    P = np.zeros((len(R), 6, 6))
    P[:, :3, :3], P[:, 3:, 3:] = noise[order], _FIRST_RATE**2 * np.eye(3)
    weight = evidence[order] - evidence[order[0]]
    return _Hypotheses(t_s, R[order], np.zeros((len(R), 3)), P, weight, R[order][:, :, 2].copy())


def _predicted(state: _Hypotheses, t_s: float) -> _Hypotheses:
    dt = min(t_s - state.t_s, _MAX_GAP_S)
    keep = float(np.exp(-dt / _DECAY_S))
    F = np.eye(6)
    F[:3, 3:], F[3:, 3:] = dt * np.eye(3), keep * np.eye(3)
    q = _ACCELERATION**2
    Q = np.kron(np.array([[q * dt**3 / 3.0, q * dt**2 / 2.0], [q * dt**2 / 2.0, q * dt]]), np.eye(3))
    rotated = np.stack([rotation_from_vector(rate * dt) @ R for rate, R in zip(state.rate, state.R, strict=True)])
    return _Hypotheses(t_s, rotated, keep * state.rate, F @ state.P @ F.T + Q, state.weight, state.facing)


def _updated(
    state: _Hypotheses, before_s: float, R: FloatArray, noise: FloatArray, evidence: FloatArray
) -> _Hypotheses:
    """Return the best of all pairs of a hypothesis and a pose."""
    count, poses = len(state.R), len(R)
    dt = min(state.t_s - before_s, _MAX_GAP_S)
    innovation = _vectors(R[None] @ np.swapaxes(state.R, 1, 2)[:, None])
    S = state.P[:, None, :3, :3] + noise[None]
    inverse = np.linalg.inv(S)
    distance = np.einsum("nmi,nmij,nmj->nm", innovation, inverse, innovation)
    facing = state.facing / np.maximum(np.linalg.norm(state.facing, axis=1, keepdims=True), 1e-9)
    away = np.arccos(np.clip(facing @ R[:, :, 2].T, -1.0, 1.0))
    likelihood = -0.5 * (np.minimum(distance, _MAX_DISTANCE) + np.log(np.linalg.det(S)))
    weight = (state.weight[:, None] + likelihood + evidence - _FACING_WEIGHT * dt * away**2).ravel()
    gain = state.P[:, None, :, :3] @ inverse
    pull = np.sqrt(np.minimum(1.0, _MAX_DISTANCE / np.maximum(distance, 1e-12)))
    step = np.einsum("nmij,nmj->nmi", gain, innovation * pull[..., None]).reshape(-1, 6)
    P = (state.P[:, None] - gain @ state.P[:, None, :3, :]).reshape(-1, 6, 6)
    rate = np.repeat(state.rate, poses, axis=0) + step[:, 3:]
    parent = np.repeat(np.arange(count), poses)
    kept: list[int] = []
    orientations: list[FloatArray] = []
    best = float(weight.max())
    for place in np.argsort(-weight).tolist():
        if weight[place] < best - _DROP or len(kept) == _HYPOTHESES:
            break
        orientation = rotation_from_vector(step[place, :3]) @ state.R[parent[place]]
        if all(rotation_cosine(orientation, other) < _MERGE_COSINE for other in orientations):
            kept.append(place)
            orientations.append(orientation)
    chosen = np.stack(orientations)
    share = min(1.0, dt / _FACING_S)
    mean = (1.0 - share) * state.facing[parent[kept]] + share * chosen[:, :, 2]
    return _Hypotheses(state.t_s, chosen, rate[kept], P[kept], weight[kept] - best, mean)


def _vectors(R: FloatArray) -> FloatArray:
    """Return axis times angle (..., 3), radians, of rotations (..., 3, 3)."""
    xyzw = quaternion_from_rotation(R)
    xyzw = np.where(xyzw[..., 3:] < 0.0, -xyzw, xyzw)
    sine = np.linalg.norm(xyzw[..., :3], axis=-1, keepdims=True)
    angle = 2.0 * np.arctan2(sine, xyzw[..., 3:])
    vectors: FloatArray = xyzw[..., :3] * np.where(sine > 1e-9, angle / np.maximum(sine, 1e-9), 2.0)
    return vectors
