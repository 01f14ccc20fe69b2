"""One extended Kalman filter over all markers of a hand.

The state is (p, v): places, then velocities, each 3 M numbers, marker by marker. A frame is one update, at one moment;
a marker whose row was exposed δ later is observed through p + δ v. The filter's arrays are replaced and never changed
in place, so that a state that somebody keeps stays as it is.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from rhot.geometry.camera import CameraModel
from rhot_fusion.filter.motion import acceleration_covariance
from rhot_fusion.filter.settings import MotionSettings

FloatArray = NDArray[np.float64]
BoolArray = NDArray[np.bool_]
IndexArray = NDArray[np.intp]

_HUBER = 9.0
"""Squared Mahalanobis distance beyond which a view's variance grows in proportion to it."""
_NEAREST_M = 0.05
"""A marker on or behind the image plane has no useful derivative; its innovation refuses it."""
_REACH = 0.02
"""Arms are computed anew when a marker has moved this far about its hand, metres."""


@dataclass(frozen=True, slots=True)
class Views:
    """What one frame says of N markers.

    Attributes:
        camera: that took it.
        index: (N,) markers, ascending.
        delta_s: (N,) time of each after the frame's.
        xy: (N, 2) normalised image coordinates.
        variance: (N, 2, 2) of them.
        slack: (N,) standard deviation beyond that which the gate allows for, normalised units.
    """

    camera: CameraModel
    index: IndexArray
    delta_s: FloatArray
    xy: FloatArray
    variance: FloatArray
    slack: FloatArray


@dataclass(frozen=True, slots=True)
class State:
    """The markers of a hand at one moment.

    Attributes:
        t_s: the moment.
        mean: (2, 3 M) places and velocities, metres and metres per second.
        covariance: (6 M, 6 M).
        weight: (K,) of the scales.
        alive: (M,) markers that are in it; the others' rows are zero.
    """

    t_s: float
    mean: FloatArray
    covariance: FloatArray
    weight: FloatArray
    alive: BoolArray


@dataclass(frozen=True, slots=True)
class Innovation:
    """How the N views of a frame differed from what was expected.

    Attributes:
        y: (N, 2) innovation, normalised units.
        S: (N, 2, 2) its covariance.
        nis: (N,) its squared Mahalanobis distance.
        accepted: (N,) whether it passed the gate.
        evidence: (K,) logarithm of the likelihood of each scale, but for a constant.
    """

    y: FloatArray
    S: FloatArray
    nis: FloatArray
    accepted: BoolArray
    evidence: FloatArray


@dataclass(frozen=True, slots=True)
class Step:
    """What a frame did, for smoothing.

    Attributes:
        dt_s: time since the step before.
        before: the state before its observations, with the noise of the way there.
        after: the state after them.
    """

    dt_s: float
    before: State
    after: State


class JointFilter:
    """The filter of M markers of one hand.

    Attributes:
        state: of now.
    """

    def __init__(self, count: int, settings: MotionSettings, gate: float) -> None:
        self._count = count
        self._settings = settings
        self._gate = gate
        self._scales2: FloatArray = np.square(settings.scales)
        self._shares: FloatArray = np.array(settings.shares)
        self._accelerations: tuple[FloatArray, BoolArray, FloatArray] | None = None
        self.clear()

    def clear(self) -> None:
        """Forget all markers."""
        size = 3 * self._count
        self.state = State(
            -np.inf,
            np.zeros((2, size)),
            np.zeros((2 * size, 2 * size)),
            self._shares,
            np.zeros(self._count, dtype=bool),
        )

    @property
    def place(self) -> FloatArray:
        """(M, 3) metres."""
        place: FloatArray = self.state.mean[0].reshape(-1, 3)
        return place

    @property
    def velocity(self) -> FloatArray:
        """(M, 3) metres per second."""
        velocity: FloatArray = self.state.mean[1].reshape(-1, 3)
        return velocity

    def begin(self, marker: int, mean: FloatArray, covariance: FloatArray, t_s: float) -> None:
        """Put a marker in with a state (6,) of covariance (6, 6) at a moment, the filter's own or its first."""
        old = self.state
        if not old.alive.any():
            old = State(t_s, old.mean, old.covariance, self._shares, old.alive)
        x, P, alive = old.mean.copy(), _without(old.covariance, marker), old.alive.copy()
        rows = slice(3 * marker, 3 * marker + 3)
        x[0, rows], x[1, rows] = mean[:3], mean[3:]
        P.reshape(2, self._count, 3, 2, self._count, 3)[:, marker, :, :, marker] = covariance.reshape(2, 3, 2, 3)
        alive[marker] = True
        self.state = State(old.t_s, x, P, old.weight, alive)

    def end(self, marker: int) -> None:
        """Take a marker out."""
        old = self.state
        alive = old.alive.copy()
        alive[marker] = False
        self.state = State(old.t_s, old.mean, _without(old.covariance, marker), old.weight, alive)

    def predicted(self, t_s: float) -> State:
        """Return the state at a moment that is not before the filter's; nothing changes."""
        state, dt = self._moved(t_s)
        return self._noisy(state, dt, self._scale2(state.weight))

    def step(self, t_s: float, views: Views, scale2: float | None = None) -> tuple[Innovation, Step]:
        """Move on to a moment that is not before the filter's and take a frame's views of markers that are alive.

        Args:
            t_s: the moment.
            views: that are taken if they pass the gate.
            scale2: square of the scale of accelerations; weighed by the views when not given.
        """
        state, dt = self._moved(t_s)
        H, y = _observation(state, views, self._count)
        innovation, state = self._judge(state, dt, views, H, y)
        before = self._noisy(state, dt, self._scale2(state.weight) if scale2 is None else scale2)
        # What lies far off counts less: Huber's loss.
        variance = views.variance * np.maximum(1.0, innovation.nis / _HUBER)[:, None, None]
        views = replace(views, variance=variance)
        self.state = self._updated(before, views, H, y, innovation.accepted)
        return innovation, Step(dt, before, self.state)

    def _scale2(self, weight: FloatArray) -> float:
        return float(weight @ self._scales2)

    def _moved(self, t_s: float) -> tuple[State, float]:
        """Return the state at a moment without the noise of the way, and how long that is."""
        old, settings = self.state, self._settings
        dt = max(t_s - old.t_s, 0.0) if np.isfinite(old.t_s) else 0.0
        if dt == 0.0:
            return State(max(t_s, old.t_s), old.mean, old.covariance, old.weight, old.alive), 0.0
        x = carried(old.mean.reshape(-1, 1), dt, old.alive, settings).reshape(2, -1)
        P = carried(carried(old.covariance, dt, old.alive, settings).T, dt, old.alive, settings)
        stay = np.exp(-dt / settings.switch_s)
        weight = stay * old.weight + (1.0 - stay) * self._shares
        return State(max(t_s, old.t_s), x, P, weight, old.alive), dt

    def _acceleration(self, state: State) -> FloatArray:
        """Return the covariance (3 M, 3 M) of accelerations for the scale 1."""
        place, alive = state.mean[0].reshape(-1, 3), state.alive
        known = self._accelerations
        if known is not None and (known[1] == alive).all():
            moved = (place - known[0])[alive]
            if len(moved) == 0 or float(np.abs(moved - moved.mean(axis=0)).max()) < _REACH:
                return known[2]
        C = np.zeros((3 * self._count, 3 * self._count))
        there = np.flatnonzero(alive)
        if len(there):
            rows = (there[:, None] * 3 + np.arange(3)).ravel()
            C[np.ix_(rows, rows)] = acceleration_covariance(place[there], self._settings)
        self._accelerations = place.copy(), alive, C
        return C

    def _noisy(self, state: State, dt: float, scale2: float) -> State:
        """Return a state with the noise of the last dt added."""
        if dt == 0.0:
            return state
        half = 3 * self._count
        C = scale2 * dt * self._acceleration(state)
        P = state.covariance.copy()
        P[:half, :half] += (dt * dt / 3.0) * C
        across = (dt / 2.0) * C
        P[:half, half:] += across
        P[half:, :half] += across
        P[half:, half:] += C
        return State(state.t_s, state.mean, P, state.weight, state.alive)

    def _judge(self, state: State, dt: float, views: Views, H: FloatArray, y: FloatArray) -> tuple[Innovation, State]:
        """Weigh the scales by a frame's views, each marker by itself, and gate the views."""
        index, count = views.index, len(views.index)
        if not count:
            return Innovation(
                y, np.zeros((0, 2, 2)), np.zeros(0), np.zeros(0, dtype=bool), np.zeros_like(state.weight)
            ), state
        own = state.covariance.reshape(2, self._count, 3, 2, self._count, 3)[:, index, :, :, index].reshape(count, 6, 6)
        S = H @ own @ H.swapaxes(1, 2) + views.variance
        C = self._acceleration(state).reshape(self._count, 3, self._count, 3)[index, :, index]
        J, delta = H[:, :, :3], views.delta_s
        # What acceleration adds over dt, seen δ later, and between the frame's moment and the row's.
        added = np.maximum(dt * dt * dt / 3.0 + dt * dt * delta + dt * delta * delta, 0.0) + np.abs(delta) ** 3 / 3.0
        Q = (J @ C @ J.swapaxes(1, 2)) * added[:, None, None]
        all_S = S + self._scales2[:, None, None, None] * Q
        a, b, c = all_S[..., 0, 0], all_S[..., 0, 1], all_S[..., 1, 1]
        det = a * c - b * b
        y0, y1 = y[:, 0], y[:, 1]
        nis = (c * (y0 * y0) - 2.0 * b * (y0 * y1) + a * (y1 * y1)) / det
        # What no gate would pass tells of an outlier, not of a scale.
        evidence = -0.5 * (np.minimum(nis, self._gate) + np.log(det)).sum(axis=1)
        weight = state.weight * np.exp(evidence - evidence.max())
        weight /= weight.sum()
        S += self._scale2(weight) * Q
        a, b, c = S[:, 0, 0], S[:, 0, 1], S[:, 1, 1]
        distance2 = (c * (y0 * y0) - 2.0 * b * (y0 * y1) + a * (y1 * y1)) / (a * c - b * b)
        slack2 = views.slack * views.slack
        a, c = a + slack2, c + slack2
        loose2 = (c * (y0 * y0) - 2.0 * b * (y0 * y1) + a * (y1 * y1)) / (a * c - b * b)
        accepted = loose2 <= self._gate
        return Innovation(y, S, distance2, accepted, evidence), State(
            state.t_s, state.mean, state.covariance, weight, state.alive
        )

    def _updated(self, state: State, views: Views, H: FloatArray, y: FloatArray, chosen: BoolArray) -> State:
        """Return the state after the chosen (N,) views."""
        if not chosen.all():
            H, y = H[chosen], y[chosen]
        index = views.index[chosen]
        count, size = len(index), 6 * self._count
        if not count:
            return state
        P = state.covariance
        rows = P.reshape(2, self._count, 3, size)[:, index].swapaxes(0, 1).reshape(count, 6, size)
        B = (H @ rows).reshape(2 * count, size)
        own = B.reshape(2 * count, 2, self._count, 3)[:, :, index].transpose(2, 0, 1, 3).reshape(count, 2 * count, 6)
        S = (own @ H.swapaxes(1, 2)).swapaxes(0, 1).reshape(2 * count, 2 * count)
        delta, scale2 = np.abs(views.delta_s[chosen]), self._scale2(state.weight)
        J = H[:, :, :3]
        # The noise between the frame's moment and the row's, as if independent of the way before.
        between = (scale2 * self._settings.own**2 / 3.0) * delta**3
        own_noise = views.variance[chosen] + between[:, None, None] * (J @ J.swapaxes(1, 2))
        diagonal = np.arange(count)
        S.reshape(count, 2, count, 2)[diagonal, :, diagonal] += own_noise
        L = np.linalg.cholesky(0.5 * (S + S.T))
        whitened = np.linalg.solve(L, np.concatenate([B, y.reshape(-1, 1)], axis=1))
        W = whitened[:, :-1]
        mean = state.mean + (whitened[:, -1] @ W).reshape(2, -1)
        return State(state.t_s, mean, P - W.T @ W, state.weight, state.alive)


def carried(X: FloatArray, dt: float, alive: BoolArray, settings: MotionSettings) -> FloatArray:
    """Return F X for the transition F of a state (6 M, ...) over a time, seconds: velocities join that of the hand."""
    X = X.copy()
    half, count = len(X) // 2, len(alive)
    X[:half] += dt * X[half:]
    there = np.flatnonzero(alive)
    if dt > 0.0 and len(there) > 1:
        share = -math.expm1(-dt / settings.joining_s)
        velocity = X[half:].reshape(count, 3, -1)
        if len(there) == count:
            velocity += share * (velocity.mean(axis=0) - velocity)
        else:
            own = velocity[there]
            velocity[there] = own + share * (own.mean(axis=0) - own)
    return X


def _without(P: FloatArray, marker: int) -> FloatArray:
    """Return a covariance with the rows and columns of a marker zero."""
    count = len(P) // 6
    P = P.copy()
    view = P.reshape(2, count, 3, 2, count, 3)
    view[:, marker] = 0.0
    view[:, :, :, :, marker] = 0.0
    return P


def _observation(state: State, views: Views, count: int) -> tuple[FloatArray, FloatArray]:
    """Return the derivatives (N, 2, 6) of views by their markers' states, and the innovations (N, 2)."""
    mean = state.mean.reshape(2, count, 3)[:, views.index]
    delta = views.delta_s[:, None]
    R = views.camera.R_camera_rig
    local = (mean[0] + delta * mean[1]) @ R.T + views.camera.t_camera_rig
    inverse = 1.0 / np.maximum(local[:, 2:], _NEAREST_M)
    xy = local[:, :2] * inverse
    J = (R[:2] - xy[:, :, None] * R[2]) * inverse[:, :, None]
    return np.concatenate([J, delta[:, :, None] * J], axis=2), views.xy - xy
