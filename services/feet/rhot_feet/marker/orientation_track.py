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

from rhot.arrays import FloatArray
from rhot.geometry.rotations import rotation_cosine, rotation_from_vector, rotation_vectors
from rhot_feet.marker.pose import MarkerPose

_MOST_NIS: Final = 24.0
"""A squared Mahalanobis distance counts for no more; measurements farther out pull as if this far."""
_LONGEST_GAP_S: Final = 0.5
"""A longer pause counts as one of this length."""
_STEEP_RAD: Final = float(np.radians(25.0))
"""Tilt against the line of sight from which the corners tell the two poses apart, and the margin from which the
likelier one is then believed. Below, only one hypothesis may be left: the errors of corners are the same in picture
after picture, so that what they add up to overstates what is known.
"""


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

    def is_clear(self, t_camera_marker: FloatArray) -> bool:
        """Return whether the orientation may be believed of a marker at a position (3,), metres, camera frame.

        Seen nearly head-on, a square and its mirrored pose look alike, and no number of pictures tells them apart.
        """
        if self._state is None or self.margin == float("inf"):
            return self._state is not None
        towards = -t_camera_marker / max(float(np.linalg.norm(t_camera_marker)), 1e-9)
        steep = float(self._state.R[0, :, 2] @ towards) <= np.cos(_STEEP_RAD)
        steep_margin = 10.0
        return steep and self.margin >= steep_margin

    def update(self, t_s: float, poses: Sequence[MarkerPose]) -> int:
        """Update with the poses of one picture and return the index of the one to believe, see `nearest`.

        Args:
            t_s: time, seconds; later than the picture before.
            poses: at least one.
        """
        R = np.stack([pose.R_camera_marker for pose in poses])
        # Noise that no reprojection error shows: bowed paper, lens, size.
        noise = np.stack([pose.covariance[:3, :3] for pose in poses]) + (float(np.radians(2.0))) ** 2 * np.eye(3)
        costs = np.array([pose.cost for pose in poses])
        # Log-likelihood that one picture says at most: its corners share their errors.
        evidence = np.maximum(-0.5 * (costs - costs.min()), -3.0)
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
    # Standard deviation of the angular rate of a new marker.
    P[:, :3, :3], P[:, 3:, 3:] = noise[order], 2.0**2 * np.eye(3)
    weight = evidence[order] - evidence[order[0]]
    return _Hypotheses(t_s, R[order], np.zeros((len(R), 3)), P, weight, R[order][:, :, 2].copy())


def _predicted(state: _Hypotheses, t_s: float) -> _Hypotheses:
    dt = min(t_s - state.t_s, _LONGEST_GAP_S)
    # Time constant of the angular rate.
    keep = float(np.exp(-dt / 0.15))
    F = np.eye(6)
    F[:3, 3:], F[3:, 3:] = dt * np.eye(3), keep * np.eye(3)
    # Root of the spectral density of the angular acceleration, rad/s^1.5: hands and feet.
    q = 8.0**2
    Q = np.kron(np.array([[q * dt**3 / 3.0, q * dt**2 / 2.0], [q * dt**2 / 2.0, q * dt]]), np.eye(3))
    rotated = np.stack([rotation_from_vector(rate * dt) @ R for rate, R in zip(state.rate, state.R, strict=True)])
    return _Hypotheses(t_s, rotated, keep * state.rate, F @ state.P @ F.T + Q, state.weight, state.facing)


def _updated(
    state: _Hypotheses, before_s: float, R: FloatArray, noise: FloatArray, evidence: FloatArray
) -> _Hypotheses:
    """Return the best of all pairs of a hypothesis and a pose."""
    count, poses = len(state.R), len(R)
    dt = min(state.t_s - before_s, _LONGEST_GAP_S)
    innovation = rotation_vectors(R[None] @ np.swapaxes(state.R, 1, 2)[:, None])
    S = state.P[:, None, :3, :3] + noise[None]
    inverse = np.linalg.inv(S)
    distance = np.einsum("nmi,nmij,nmj->nm", innovation, inverse, innovation)
    facing = state.facing / np.maximum(np.linalg.norm(state.facing, axis=1, keepdims=True), 1e-9)
    away = np.arccos(np.clip(facing @ R[:, :, 2].T, -1.0, 1.0))
    likelihood = -0.5 * (np.minimum(distance, _MOST_NIS) + np.log(np.linalg.det(S)))
    # Log-likelihood lost per second and square radian away from where the marker has
    # looked over this time constant.
    weight = (state.weight[:, None] + likelihood + evidence - 60.0 * dt * away**2).ravel()
    gain = state.P[:, None, :, :3] @ inverse
    pull = np.sqrt(np.minimum(1.0, _MOST_NIS / np.maximum(distance, 1e-12)))
    step = np.einsum("nmij,nmj->nmi", gain, innovation * pull[..., None]).reshape(-1, 6)
    P = (state.P[:, None] - gain @ state.P[:, None, :3, :]).reshape(-1, 6, 6)
    rate = np.repeat(state.rate, poses, axis=0) + step[:, 3:]
    parent = np.repeat(np.arange(count), poses)
    kept: list[int] = []
    orientations: list[FloatArray] = []
    best = float(weight.max())
    for index in np.argsort(-weight).tolist():
        # How many are kept, which count as alike, and log-likelihood below
        # the best at which one is dropped.
        if weight[index] < best - 15.0 or len(kept) == 6:
            break
        orientation = rotation_from_vector(step[index, :3]) @ state.R[parent[index]]
        if all(rotation_cosine(orientation, other) < (float(np.cos(np.radians(4.0)))) for other in orientations):
            kept.append(index)
            orientations.append(orientation)
    chosen = np.stack(orientations)
    share = min(1.0, dt / 2.0)
    mean = (1.0 - share) * state.facing[parent[kept]] + share * chosen[:, :, 2]
    return _Hypotheses(state.t_s, chosen, rate[kept], P[kept], weight[kept] - best, mean)
