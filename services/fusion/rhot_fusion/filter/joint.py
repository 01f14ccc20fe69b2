"""One extended Kalman filter over all markers of a hand, with the motion model of `motion`.

Each frame is one update at one time. A marker at p with velocity v, whose image row was exposed δ later, is observed as
project(R_camera_rig (p + δ v) + t_camera_rig).
"""

from __future__ import annotations

import math
from dataclasses import replace
from functools import lru_cache
from typing import Final

import cv2
import numpy as np

from rhot.arrays import BoolArray, FloatArray, IndexArray
from rhot.geometry.camera import CameraModel
from rhot.types import Vector3
from rhot_fusion.filter.motion import MotionModel, motion_of
from rhot_fusion.filter.state import ROUND, SHARED, FilterStep, Innovation, State, Views
from rhot_fusion.views.sightings import Upper

SCALES: Final = (0.01, 0.1, 0.5, 1.6, 5.0, 16.0)
"""Noise intensities that multiply the strengths of `motion`: square roots of the acceleration's power spectral
density, m/s^1.5, from a hand at rest to 40 m/s² within one frame. The filter weights them by the likelihood of the
observations.
"""
SHARES: Final = (0.1, 0.2, 0.3, 0.25, 0.13, 0.02)
"""Prior probability of each scale."""
SWITCH_S: Final = 0.03
"""Time constant with which the weights of the scales return to `SHARES`, seconds. Longer values reduce jitter at rest
but make covariances too small in motion: on eight develop rigs at 60 fps, 93 % of errors are within two sigma at
0.03 and 91 % at 0.1, with a 95th percentile of 7.6 and 8.2 mm.
"""

_HUBER = 9.0
"""Squared Mahalanobis distance beyond which the variance of a view or its innovation is inflated in proportion."""
_FREEDOM = 60.0
"""Degrees of freedom of the Student t likelihood of the scales when outliers are not rejected. Between 25 and 150 the
errors of `rhot evaluate motion` at 15 to 60 fps differ by less than 4 %. With fewer, fast grasps of the rendered
pictures at 30 fps are lost. At 150, one of twelve uncalibrated rigs with 5 % wrong blobs diverges by metres."""
_ADJOINT: FloatArray = np.array([1.0, -2.0, 1.0])
_NEAREST_M = 0.05
"""Lower bound of depths, metres: behind the image plane there is no useful derivative; the gate rejects such views."""
_REACH = 0.02
"""The motion matrices are recomputed when a marker has moved this far relative to its hand, metres."""


class JointFilter:
    """Filter of the M markers of one hand.

    Attributes:
        state: current state.
    """

    def __init__(self, count: int, gate: float, *, refuses: bool = True) -> None:
        """Start without markers; if not `refuses`, views beyond the gate are down-weighted instead of rejected."""
        self._count = count
        self._gate = gate
        self._limit = gate if refuses else math.inf
        self._scales2: FloatArray = np.square(SCALES)
        self._shares: FloatArray = np.array(SHARES)
        self._motion: MotionModel | None = None
        size = 6 * count + SHARED
        self._identity: FloatArray = np.eye(size)
        self._nothing: FloatArray = np.zeros((size, size))
        self._marker: FloatArray = np.eye(count)
        # Flat indices (M, 6) of xx, xy, xz, yy, yz and zz of the markers' positions in a covariance.
        row, column = (3 * np.arange(count)[:, None] + one for one in np.triu_indices(3))
        self._own: IndexArray = row * size + column
        self._uppers: tuple[State | None, list[Upper], list[float]] = None, [], []
        self._seen_from: tuple[State | None, CameraModel | None, list[Vector3]] = None, None, []
        self.clear()

    def clear(self) -> None:
        """Discard all markers."""
        size = 6 * self._count + SHARED
        nothing = np.zeros(self._count, dtype=bool)
        self.state = State(-np.inf, np.zeros(size), np.zeros((size, size)), self._shares, nothing)

    @property
    def position(self) -> FloatArray:
        """(M, 3) metres."""
        position: FloatArray = self.state.mean[0].reshape(-1, 3)
        return position

    @property
    def velocity(self) -> FloatArray:
        """(M, 3) metres per second."""
        velocity: FloatArray = self.state.mean[1].reshape(-1, 3)
        return velocity

    @property
    def spread_m2(self) -> list[float]:
        """(M,) traces of the covariances of their positions, square metres."""
        return self._own_of(self.state)[1]

    def own(self, state: State) -> list[Upper]:
        """Return the covariances (M,) of the markers' positions in a state."""
        return self._own_of(state)[0]

    def _own_of(self, state: State) -> tuple[list[Upper], list[float]]:
        """Return the covariances (M,) of the markers' positions in a state, and their traces; cached."""
        known, own, spread_m2 = self._uppers
        if known is not state:
            own = state.P.take(self._own).tolist()
            spread_m2 = [xx + yy + zz for xx, _, _, yy, _, zz in own]
            self._uppers = state, own, spread_m2
        return own, spread_m2

    def seen_from(self, camera: CameraModel) -> list[Vector3]:
        """Return the markers' positions (M,) in a camera's frame, metres; cached for the current state."""
        state, viewer, seen = self._seen_from
        if state is not self.state or viewer is not camera:
            seen = camera.to_camera(self.position).tolist()
            self._seen_from = self.state, camera, seen
        return seen

    def begin(self, marker: int, mean: FloatArray, covariance: FloatArray, t_s: float) -> None:
        """Add a marker with mean (6,) and covariance (6, 6) at the filter's time; the first marker sets that time."""
        old = self.state
        x, P, alive = old.x.copy(), self._without(old.P, marker), old.alive.copy()
        if not alive.any():
            x[-SHARED:], P[-SHARED:] = 0.0, 0.0
            P[:, -SHARED:] = 0.0
            # Standard deviation of each component of the shared acceleration
            # when a hand is first seen.
            first = np.repeat(np.square([5.0, 40.0]), 3)
            P[-SHARED:, -SHARED:] = np.diag(first)
            old = State(t_s, x, P, self._shares, alive)
        rows = self._rows(marker)
        x[rows] = mean
        P[np.ix_(rows, rows)] = covariance
        alive[marker] = True
        self.state = State(old.t_s, x, P, old.weight, alive)

    def end(self, marker: int) -> None:
        """Remove a marker."""
        old = self.state
        alive = old.alive.copy()
        alive[marker] = False
        self.state = State(old.t_s, old.x, self._without(old.P, marker), old.weight, alive)

    def predicted(self, t_s: float) -> State:
        """Return the predicted state at a time not before the filter's; the filter is unchanged."""
        state, dt, _, Q = self._moved(t_s)
        return state if dt == 0.0 else replace(state, P=state.P + self._scale2(state.weight) * Q)

    def step(self, t_s: float, views: Views, scale2: float | None = None) -> tuple[Innovation, FilterStep]:
        """Predict to a time not before the filter's and update with a frame's views of markers that are alive.

        Args:
            t_s: the time.
            views: used as far as they pass the gate.
            scale2: squared acceleration scale; estimated from the views if None.
        """
        state, dt, F, Q = self._moved(t_s)
        if not len(views.index):
            scale2 = self._scale2(state.weight) if scale2 is None else scale2
            self.state = replace(state, P=state.P + scale2 * Q)
            nothing = np.zeros(0)
            empty = Innovation(np.zeros((0, 2)), np.zeros((0, 3)), nothing, nothing > 0.0, np.zeros_like(self._scales2))
            return empty, FilterStep(dt, F, self.state, self.state)
        H, y = self._observation(state, views)
        HP, HQ = H @ state.P, H @ Q
        S, S_more = HP @ H.T, HQ @ H.T
        own, more = _blocks(S) + views.variance, _blocks(S_more)
        evidence = self._evidence(own, more, y)
        weight = state.weight * np.exp(evidence - evidence.max())
        weight = weight / weight.sum()
        scale2 = self._scale2(weight) if scale2 is None else scale2
        before = State(state.t_s, state.x, state.P + scale2 * Q, weight, state.alive)
        HP, S, variance = HP + scale2 * HQ, S + scale2 * S_more, views.variance
        innovation = self._gated(views, y, own + scale2 * more, evidence)
        if views.certain is not None and (loose := innovation.accepted & (innovation.nis > views.certain)).any():
            before = self._loosened(before, views.index[loose], innovation.nis[loose])
            HP = H @ before.P
            S = HP @ H.T
            innovation = self._gated(views, y, _blocks(S) + variance, evidence)
        if innovation.nis.max() > _HUBER:
            # Huber's loss. With a gate, only the variance of the view is inflated. Without one, that of the whole
            # innovation is, because an outlier could otherwise move a marker with a large covariance.
            doubted = views.variance if math.isfinite(self._limit) else innovation.S
            variance = variance + np.maximum(innovation.nis / _HUBER - 1.0, 0.0)[:, None] * doubted
        _add_blocks(S, variance)
        self.state = _updated(before, HP, S, y, innovation.accepted)
        return innovation, FilterStep(dt, F, before, self.state)

    def _scale2(self, weight: FloatArray) -> float:
        return float(weight @ self._scales2)

    def _loosened(self, state: State, index: IndexArray, nis: FloatArray) -> State:
        """Return a state with inflated covariances of the markers whose views lie far from the prediction."""
        P = state.P.copy()
        for marker, distance2 in zip(index.tolist(), nis.tolist(), strict=True):
            rows = self._rows(marker)
            own = np.ix_(rows, rows)
            P[own] += (0.5 * distance2 - 1.0) * state.P[own]
        return replace(state, P=P)

    def _moved(self, t_s: float) -> tuple[State, float, FloatArray, FloatArray]:
        """Return the state predicted without process noise, the time step, its transition and its process noise."""
        old = self.state
        dt = max(t_s - old.t_s, 0.0) if math.isfinite(old.t_s) else 0.0
        if dt == 0.0:
            moved = old if t_s <= old.t_s else State(t_s, old.x, old.P, old.weight, old.alive)
            return moved, 0.0, self._identity, self._nothing
        motion = self._motion_of(old)
        F = motion.transition(dt)
        stay = math.exp(-dt / SWITCH_S)
        weight = stay * old.weight + (1.0 - stay) * self._shares
        return State(t_s, F @ old.x, F @ old.P @ F.T, weight, old.alive), dt, F, motion.noise(dt)

    def _motion_of(self, state: State) -> MotionModel:
        known, alive = self._motion, state.alive
        position = state.x[: 3 * self._count].reshape(-1, 3)
        if known is not None and (known.alive is alive or (known.alive == alive).all()):
            moved = (position - known.position)[known.index]
            if not len(moved) or float(np.abs(moved - moved[0]).max()) < _REACH:
                return known
        self._motion = motion_of(position.copy(), alive)
        return self._motion

    def _rows(self, marker: int) -> IndexArray:
        half, three = 3 * self._count, np.arange(3 * marker, 3 * marker + 3)
        return np.concatenate([three, half + three])

    def _without(self, P: FloatArray, marker: int) -> FloatArray:
        """Return a covariance with the rows and columns of a marker zero."""
        P, rows = P.copy(), self._rows(marker)
        P[rows] = 0.0
        P[:, rows] = 0.0
        return P

    def _observation(self, state: State, views: Views) -> tuple[FloatArray, FloatArray]:
        """Return the Jacobian H (2 N, n) of N views with respect to the state, and their innovations (N, 2).

        Process noise between the frame's time and the row's exposure is neglected: it is a third of a millimetre after
        5 ms, half a read-out, at the scale 1.6 of fast hands, and has no effect on the figures of `rhot evaluate
        motion`.
        """
        half, number, index = 3 * self._count, len(views.index), views.index
        position, velocity = state.x[:-SHARED].reshape(2, self._count, 3).take(index, axis=1)
        R = views.camera.R_camera_rig
        local = (position + views.delta_s[:, None] * velocity) @ R.T + views.camera.t_camera_rig
        inverse = 1.0 / np.maximum(local[:, 2:], _NEAREST_M)
        xy = local[:, :2] * inverse
        J = (R[:2] - xy[:, :, None] * R[2]) * inverse[:, :, None]
        # Each view depends only on its own marker's columns.
        by_place = (self._marker.take(index, axis=0)[:, None, :, None] * J[:, :, None, :]).reshape(number, 2, half)
        H = np.zeros((number, 2, len(state.x)))
        H[:, :, :half] = by_place
        H[:, :, half : 2 * half] = views.delta_s[:, None, None] * by_place
        return H.reshape(2 * number, -1), views.xy - xy

    def _evidence(self, own: FloatArray, more: FloatArray, y: FloatArray) -> FloatArray:
        """Return the log-likelihood (K,) of each scale s, with the covariance own + s² more of each marker."""
        S = own + self._scales2[:, None, None] * more
        nis = squared_distance(S, y)
        # Beyond the gate, an innovation is an outlier and not evidence for a scale.
        refuses = math.isfinite(self._limit)
        nis = np.minimum(nis, self._gate) if refuses else (_FREEDOM + 2.0) * np.log1p(nis / _FREEDOM)
        evidence: FloatArray = -0.5 * (nis + np.log(determinant(S))).sum(axis=1)
        return evidence

    def _gated(self, views: Views, y: FloatArray, S: FloatArray, evidence: FloatArray) -> Innovation:
        """Apply the gate to each of a frame's views, with innovation covariances S (N, 3)."""
        nis = squared_distance(S, y)
        if nis.max() <= self._limit:
            accepted = nis <= self._limit
        else:
            accepted = squared_distance(S + (views.slack * views.slack)[:, None] * ROUND, y) <= self._limit
        return Innovation(y, S, nis, accepted, evidence)


@lru_cache
def _entries(number: int) -> tuple[IndexArray, IndexArray]:
    """Return flat indices of the diagonal blocks of a matrix (2 N, 2 N): xx, xy, yy (N, 3), and with yx (N, 4)."""
    first = (2 * number + 1) * 2 * np.arange(number)[:, None]
    return first + np.array((0, 1, 2 * number + 1)), first + np.array((0, 1, 2 * number, 2 * number + 1))


def _blocks(S: FloatArray) -> FloatArray:
    """Return xx, xy and yy (N, 3) of the blocks along the diagonal of (2 N, 2 N)."""
    return S.take(_entries(len(S) // 2)[0])


def _products(y: FloatArray) -> FloatArray:
    """Return xx, xy and yy (N, 3) of the outer products y yᵀ of y (N, 2)."""
    products: FloatArray = y.take((0, 0, 1), axis=1) * y.take((0, 1, 1), axis=1)
    return products


def determinant(S: FloatArray) -> FloatArray:
    """Return the determinants (...,) of covariances (..., 3)."""
    xx, xy, yy = S[..., 0], S[..., 1], S[..., 2]
    det: FloatArray = xx * yy - xy * xy
    return det


def squared_distance(S: FloatArray, y: FloatArray) -> FloatArray:
    """Return the squared Mahalanobis distances of y (N, 2) by covariances (..., N, 3)."""
    # The adjoint of S holds yy, −xy and xx.
    adjoint = _products(y)[:, ::-1] * _ADJOINT
    distance2: FloatArray = np.vecdot(S, adjoint) / determinant(S)
    return distance2


def _add_blocks(S: FloatArray, blocks: FloatArray) -> None:
    """Add xx, xy and yy (N, 3) along the diagonal of (2 N, 2 N)."""
    S.reshape(-1)[_entries(len(blocks))[1]] += blocks.take((0, 1, 1, 2), axis=1)


def _updated(state: State, HP: FloatArray, S: FloatArray, y: FloatArray, chosen: BoolArray) -> State:
    """Return the state after the chosen (N,) views."""
    y = y.ravel()
    if not chosen.all():
        if not chosen.any():
            return state
        rows = np.repeat(chosen, 2)
        HP, S, y = HP[rows], S[np.ix_(rows, rows)], y[rows]
    # OpenCV's inverse by Cholesky takes a third of the time of numpy's, most of which is overhead at this size.
    regular, inverse = cv2.invert(S, flags=cv2.DECOMP_CHOLESKY)
    # For a single view OpenCV only checks whether the determinant is 0, for more whether all pivots are positive.
    if not (regular and S[0, 0] > 0.0 and S[1, 1] > 0.0 and inverse[0, 0] > 0.0):
        # S is singular by rounding, e.g. behind a camera or after a divergence: skip these views.
        return state
    gain = inverse @ HP
    P = state.P - HP.T @ gain
    # Symmetrise, because asymmetric rounding errors would grow with every update.
    return State(state.t_s, state.x + y @ gain, 0.5 * (P + P.T), state.weight, state.alive)
