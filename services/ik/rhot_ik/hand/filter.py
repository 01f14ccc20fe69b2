"""The whole hand as one filter: wrist pose and twenty angles from all points of all samples together.

State and prediction are `rhot_ik.hand.process`'s.

Measurements, each with its own 3x3 covariance: the base marker p + R·b; each tip p + R·m(q); and the corners of the
base patch, which are first made into one rotation with its information matrix. The update is the iterated extended
Kalman filter, which is Gauss–Newton on the posterior (Bell & Cathey 1993), with analytic derivatives. Limits are hard:
angles that leave them are set to the limit and all others moved by what that says about them (projection of the
estimate in the metric of P, Simon & Chia 2002).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from rhot.geometry.covariances import symmetric_inverse
from rhot.geometry.rotations import cross_matrix, rotation_from_vector, vector_from_rotation
from rhot_ik.hand.evidence import Evidence
from rhot_ik.hand.finger_geometry import FingerGeometry
from rhot_ik.hand.fingers import AnalyticFingers
from rhot_ik.hand.kinematics import HandKinematics
from rhot_ik.hand.prior import COUNT
from rhot_ik.hand.process import ANGLES, POSITION, ROTATION, SIZE, SPEED, TURNING, HandProcess, HandState

FloatArray = NDArray[np.float64]
BoolArray = NDArray[np.bool_]

MOST_SURPRISE: Final = 30.0
"""A finger that moves faster than the process expects gets up to this many times its room."""
CLOSE_RAD: Final = 0.05
"""Steps end when the derivatives were taken this near to where they led."""
FAR_M: Final = 0.015
"""When a tip lies further than this from where it was expected, the first step sets out from the closed form."""
OUTLIER: Final = 10.0
"""A tip this many standard deviations from what was expected loses weight."""
MISS_M: Final = 0.012
"""A tip that no legal pose meets within this loses weight."""

_TIPS: Final = np.arange(5)
_BLOCKS: Final = np.arange(7)
"""Five tips, base and rotation: three rows of a measurement each."""
_ROWS: Final = 21
_OWN_ANGLES: Final = (3 * _TIPS[:, None, None] + np.arange(3)[:, None]) * SIZE + (
    ANGLES.start + 4 * _TIPS[:, None, None] + np.arange(4)
)
"""(5, 3, 4) places of the derivatives of each tip by its own angles in a flat (21, 32) matrix."""


@dataclass(frozen=True, slots=True)
class _Rows:
    """A sample as 21 rows of measurement: five tips, the base, the rotation.

    Attributes:
        seen: (7,) which of them were.
        counts: (21,) the same for each row, as 0 or 1.
        points: (6, 3) metres, rig frame: tips and base; 0 where not seen.
        rotation: (3, 3) wrist to rig, or not seen.
        noise: (7, 3, 3) covariances.
    """

    seen: BoolArray
    counts: FloatArray
    points: FloatArray
    rotation: FloatArray | None
    noise: FloatArray


def _rows(evidence: Evidence) -> _Rows | None:
    points = np.concatenate([evidence.tips, evidence.base[None]])
    seen = np.empty(7, dtype=np.bool_)
    seen[:6], seen[6] = np.isfinite(points).all(axis=1), evidence.rotation is not None
    if not seen.any():
        return None
    noise = np.empty((7, 3, 3))
    noise[:5], noise[5] = evidence.tip_covariances, evidence.base_covariance
    noise[6] = symmetric_inverse(evidence.rotation_information)
    points = np.where(seen[:6, None], points, 0.0)
    return _Rows(seen, np.repeat(seen, 3).astype(np.float64), points, evidence.rotation, noise)


class HandFilter(HandProcess):
    """Predicts and corrects `HandState`s of one hand; stateless after construction."""

    def __init__(self, geometry: FingerGeometry, base_offset: FloatArray) -> None:
        model = geometry.model
        super().__init__(model)
        self._kinematics = HandKinematics(geometry)
        self._stationary_inverse = np.linalg.inv(self._stationary)
        self._own_stationary = self._stationary.reshape(5, 4, 5, 4)[_TIPS, :, _TIPS]
        self._low, self._high = model.angle_min.reshape(COUNT), model.angle_max.reshape(COUNT)
        self._fingers = AnalyticFingers(geometry)
        self._resting = geometry.marker_points(self._rest.reshape(5, 4))
        self._on_wrist = np.concatenate([np.zeros((5, 3)), base_offset[None]])
        self._H = np.zeros((_ROWS, SIZE))
        self._H[:18, POSITION] = np.tile(np.eye(3), (6, 1))
        self._H[18:, ROTATION] = np.eye(3)

    def correct(self, prior: HandState, evidence: Evidence, steps: int = 2) -> HandState:
        """Return the state after a sample, by at most `steps` Gauss–Newton steps."""
        rows = _rows(evidence)
        if rows is None:
            return prior
        P, weights = prior.P, np.ones(5)
        R, p, q, dx = prior.R, prior.p, prior.angles, np.zeros(SIZE)
        wanted = np.empty((_ROWS, SIZE + 1))
        modelled = self._kinematics.markers(q)
        if self._is_far(prior, rows, modelled[0]):
            q = self._closed_form(prior, rows)
            dx[ANGLES] = q - prior.angles
            modelled = self._kinematics.markers(q)
        for step in range(steps):
            if step > 0:
                modelled = self._kinematics.markers(q)
            used, y = self._linearised(rows, R, p, modelled)
            innovation = y + used @ dx
            PHt = P @ used.T
            S = used @ PHt
            blocks = S.reshape(7, 3, 7, 3)
            blocks[_BLOCKS, :, _BLOCKS] += rows.noise
            if step == 0:
                surprise = self._surprise(innovation[:15].reshape(5, 3), blocks[_TIPS, :, _TIPS])
                weights = np.minimum(1.0, OUTLIER**2 / (3.0 * np.maximum(surprise, 1.0)))
                if prior.spread > 0.0 and surprise.max() > 1.0:
                    P = self._with_room(prior, surprise)
                    PHt = P @ used.T
                    S = used @ PHt
                    blocks = S.reshape(7, 3, 7, 3)
                    blocks[_BLOCKS, :, _BLOCKS] += rows.noise
            else:
                missed = (y[:15].reshape(5, 3) ** 2).sum(-1)
                weights = np.minimum(weights, 1.0 / (1.0 + missed / MISS_M**2))
            if weights.min() < 1.0:
                blocks[_TIPS, :, _TIPS] += rows.noise[:5] * (1.0 / weights - 1.0)[:, None, None]
            wanted[:, :SIZE], wanted[:, SIZE] = PHt.T, innovation
            solved = np.linalg.solve(S, wanted)
            posterior = P - PHt @ solved[:, :SIZE]
            about, dx = dx, self._within_limits(PHt @ solved[:, SIZE], prior.angles, posterior)
            R, p = prior.R @ rotation_from_vector(dx[ROTATION]), prior.p + dx[POSITION]
            q = prior.angles + dx[ANGLES]
            moved = np.abs(dx - about)
            if max(moved[ROTATION].max(), moved[ANGLES].max()) < CLOSE_RAD:
                break
        left = ((innovation - used @ dx)[:15].reshape(5, 3) ** 2).sum(-1)
        return HandState(
            R,
            p,
            prior.turning + dx[TURNING],
            prior.speed + dx[SPEED],
            np.minimum(np.maximum(q, self._low), self._high),
            0.5 * (posterior + posterior.T),
            missed_m=float(np.sqrt(left).sum() / max(1, np.count_nonzero(rows.seen[:5]))),
        )

    def cost(self, state: HandState, evidence: Evidence) -> float:
        """Return how ill a state explains a sample on its own: squared errors over their variances, angles included."""
        seen = np.isfinite(evidence.tips).all(axis=1)
        off = state.angles - self._rest
        cost = float(off @ self._stationary_inverse @ off)
        tips, _ = self._kinematics.markers(state.angles)
        missed = (evidence.tips - state.p - tips @ state.R.T)[seen]
        inverse = np.linalg.inv(evidence.tip_covariances[seen])
        cost += float((missed[:, None] @ inverse @ missed[:, :, None]).sum())
        if np.isfinite(evidence.base[0]):
            gap = evidence.base - state.p - state.R @ self._on_wrist[5]
            cost += float(gap @ np.linalg.solve(evidence.base_covariance, gap))
        if evidence.rotation is not None:
            turn = vector_from_rotation(state.R.T @ evidence.rotation)
            cost += float(turn @ evidence.rotation_information @ turn)
        return cost

    @staticmethod
    def _is_far(prior: HandState, rows: _Rows, expected: FloatArray) -> bool:
        """Tell whether any seen tip lies so far from the expected ones (5, 3) that derivatives there say little."""
        off = (rows.points[:5] - prior.p) @ prior.R - expected
        return bool((np.abs(off).max(axis=1) * rows.seen[:5]).max() > FAR_M)

    def _closed_form(self, prior: HandState, rows: _Rows) -> FloatArray:
        """Return the angles (20,) to linearise about: where the seen tips put their fingers under the expected palm."""
        seen = rows.seen[:5, None]
        local = np.where(seen, (rows.points[:5] - prior.p) @ prior.R, self._resting)
        angles: FloatArray = np.where(seen, self._fingers.solve(local).angles, prior.angles.reshape(5, 4))
        return angles.reshape(COUNT)

    def _linearised(
        self, rows: _Rows, R: FloatArray, p: FloatArray, modelled: tuple[FloatArray, FloatArray]
    ) -> tuple[FloatArray, FloatArray]:
        """Return H (21, 32) and what was measured beyond what a pose has, (21,); rows of what was not seen are 0.

        `modelled` are the markers and their derivatives as `HandKinematics.markers` has them.
        """
        tips, J = modelled
        arms = self._on_wrist.copy()
        arms[:5] = tips
        arms = arms @ R.T
        y = np.zeros(_ROWS)
        y[:18] = (rows.points - p - arms).reshape(-1)
        if rows.rotation is not None:
            y[18:] = vector_from_rotation(R.T @ rows.rotation)
        H = self._H.copy()
        # d(R·exp(δθ)·m) = −R·[m]×·δθ = −[R·m]×·R·δθ
        H[:18, ROTATION] = cross_matrix(arms).reshape(18, 3) @ -R
        H.reshape(-1)[_OWN_ANGLES] = R @ J
        return H * rows.counts[:, None], y * rows.counts

    @staticmethod
    def _surprise(innovation: FloatArray, S: FloatArray) -> FloatArray:
        """Return by how much the errors (5, 3) exceed their expected covariances (5, 3, 3): (5,), 1 on average."""
        surprise: FloatArray = (innovation * np.linalg.solve(S, innovation[:, :, None])[:, :, 0]).sum(-1) / 3.0
        return surprise

    def _with_room(self, prior: HandState, surprise: FloatArray) -> FloatArray:
        """Return P with more room for fingers that move faster than the process expects."""
        P = prior.P.copy()
        own = P[ANGLES, ANGLES]
        for finger, times in enumerate(surprise.tolist()):
            if times > 1.0:
                mine = slice(4 * finger, 4 * finger + 4)
                own[mine, mine] += min(times, MOST_SURPRISE) * prior.spread * self._own_stationary[finger]
        return P

    def _within_limits(self, dx: FloatArray, angles: FloatArray, P: FloatArray) -> FloatArray:
        """Return the errors with all angles legal, the others moved by what the limits say about them."""
        for _ in range(3):
            q = angles + dx[ANGLES]
            over = np.minimum(np.maximum(q, self._low), self._high) - q
            bad = np.flatnonzero(np.abs(over) > 1e-6)
            if not len(bad):
                break
            columns = P[:, ANGLES.start + bad]
            dx = dx + columns @ np.linalg.solve(columns[ANGLES.start + bad] + 1e-9 * np.eye(len(bad)), over[bad])
        return dx

    def tips(self, q: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return the markers (5, 3), metres, wrist frame, and their derivatives (5, 3, 4) by the finger's angles."""
        return self._kinematics.markers(q)
