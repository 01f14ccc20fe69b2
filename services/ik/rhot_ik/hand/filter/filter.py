"""Kalman filter of the whole hand: wrist pose, twenty angles and person-specific parameters from all points.

State and prediction are `rhot_ik.hand.filter.process`'s.

Measurements, each with its own full 3x3 covariance, so that what one camera sees counts as the ray that it is: the base
marker p + R·(b + shift); each tip p + R·m(q, length); and the corners of the base patch, which are first made into one
rotation R·exp(tilt) with its information matrix. The update is the iterated extended Kalman filter, which is
Gauss–Newton on the posterior (Bell & Cathey 1993), with analytic derivatives. Limits are hard: angles that leave them
are set to the limit and all others moved by what that says about them (`rhot_ik.hand.filter.filter`).

Points come from fusion's filter, so their errors last over samples. The process is therefore loose where a sample
tells: pose and seen fingers follow each sample, and memory serves what it leaves open. The person is learned by a
share of what a sample says of him, the rest of the hand moves by all of it (partial-update Schmidt–Kalman filter,
Brink 2017).
"""

from __future__ import annotations

import dataclasses
from typing import Final

import numpy as np

from rhot.arrays import BoolArray, FloatArray
from rhot.geometry.covariances import inverse_covariance, squared_distance, squared_distances
from rhot.geometry.rotations import cross_matrix, rotation_from_vector, vector_from_rotation
from rhot_ik.hand.closed_form import AnalyticFingers, FingerGeometry
from rhot_ik.hand.filter.evidence import Evidence, Rows, mean_residual_m, measurement_rows
from rhot_ik.hand.filter.kinematics import HandKinematics
from rhot_ik.hand.filter.process import (
    ANGLES,
    ANGULAR_VELOCITY,
    BASE_SHIFT,
    COUNT,
    ERROR_LASTS_S,
    LONGER,
    PATCH_TILT,
    PERSON,
    POSITION,
    ROTATION,
    SIZE,
    VELOCITY,
    HandProcess,
    HandState,
)

_MOST_ACTIVITY: Final = 30.0
"""Fingers that move faster than they usually do get up to this many times their diffusion. A finger turns at most at
some 20 rad/s, usually at 2 to 4.
"""
_TURN_OUTLIER: Final = 3.0
"""A patch's rotation that many standard deviations off loses weight, with the fourth power of it. Of those 30 to 45°
off what was expected half were wrong by over 15°, beyond that 61 % by over 30° (fast hands of `rhot evaluate
motion`, 30 fps, develop seeds 0 to 29): cameras out of step, another order of corners.
"""
_MISS_M: Final = 0.012
"""A tip that no pose within the limits meets within this loses weight."""

# Joint limits as inequality constraints on the estimate.
#
# The estimate is projected onto the limits in the metric of P (Simon & Chia 2002): an angle that is beyond is set to
# its limit, and all others are moved by what that says about them. That the angle is at its limit is not known, only
# that it is not beyond: of the normal distribution about the estimate the part inside is left (Simon & Simon 2010),
# and its mean square from the limit is the variance that the angle keeps. Without it a straight finger counts as
# known for certain.

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


_TIPS: Final = np.arange(5)
_BLOCKS: Final = np.arange(7)
"""Five tips, base and rotation: three rows of a measurement each."""
_ROWS: Final = 21
_OWN: Final = (3 * _TIPS[:, None, None] + np.arange(3)[:, None]) * SIZE + np.concatenate(
    [ANGLES.start + 4 * _TIPS[:, None, None] + np.arange(4), LONGER.start + _TIPS[:, None, None]], axis=2
)
"""(5, 3, 5) places of the derivatives of each tip by its own angles and length in a flat (21, 43) matrix."""
_SHIFT, _TILT, _LENGTHS = (
    slice(part.start - PERSON.start, part.stop - PERSON.start) for part in (BASE_SHIFT, PATCH_TILT, LONGER)
)
_TURNS: Final = np.array([*range(3), *range(ANGLES.start, ANGLES.stop)])
_UNIT: Final = np.eye(3)


class HandFilter(HandProcess):
    """Predicts and corrects `HandState`s of one hand; stateless after construction.

    Args:
        geometry: the hand and where its markers are painted.
        base_offset: (3,) metres: where the model has the base marker, wrist frame.
        known: (6,) of which markers a calibration has measured where they sit.
    """

    def __init__(
        self,
        geometry: FingerGeometry,
        base_offset: FloatArray,
        known: BoolArray,
    ) -> None:
        model = geometry.model
        super().__init__(model, known)
        self._kinematics = HandKinematics(geometry)
        self._stationary_inverse = np.linalg.inv(self._stationary)
        self._person_inverse = np.linalg.inv(self._person)
        self._low, self._high = model.angle_min.reshape(COUNT), model.angle_max.reshape(COUNT)
        self._fingers = AnalyticFingers(geometry)
        self._resting = geometry.marker_points(self._rest.reshape(5, 4))
        self._base_offset = base_offset
        self._model = model
        self._H = np.zeros((_ROWS, SIZE))
        self._H[:18, POSITION] = np.tile(_UNIT, (6, 1))
        self._H[18:, PATCH_TILT] = _UNIT

    def patch_rotation(self, state: HandState) -> FloatArray:
        """Return how the patch lies, (3, 3), patch to rig, as a state has it."""
        return state.R @ rotation_from_vector(state.person[_TILT])

    def update(self, prior: HandState, evidence: Evidence, steps: int = 2) -> HandState:
        """Return the state after a sample, by at most `steps` Gauss–Newton steps.

        Args:
            prior: the state as it was expected.
            evidence: of the sample.
            steps: the most.
        """
        rows = measurement_rows(evidence)
        if rows is None:
            return dataclasses.replace(prior, prior_covariance=prior.P)
        P, given, dx = prior.P, rows.noise, np.zeros(SIZE)
        # What the very first sample tells of a person counts as one that comes this much later.
        learned = min(1.0, (prior.dt_s or 0.1) / ERROR_LASTS_S)
        at = prior
        modelled = self._kinematics.markers(at.angles, at.person[_LENGTHS])
        far = self._is_far(prior, rows, modelled[0])
        if far:
            dx[ANGLES] = self._closed_form(prior, rows) - prior.angles
            at = dataclasses.replace(prior, angles=prior.angles + dx[ANGLES])
            modelled = self._kinematics.markers(at.angles, at.person[_LENGTHS])
        for step in range(steps):
            if step > 0:
                modelled = self._kinematics.markers(at.angles, at.person[_LENGTHS])
            H, y = self._linearise(rows, at, modelled)
            innovation = y + H @ dx
            if step == 0:
                P, PHt, S, given = self._inflated(prior, rows, H, innovation)
                noise = given
            else:
                PHt = P @ H.T
                S = H @ PHt
            if far or step > 0:
                noise = self._downweighted(rows, given, y, H[:15, :6] if step == 0 else None, P[:6, :6])
            S.reshape(7, 3, 7, 3)[_BLOCKS, :, _BLOCKS] += noise
            gain = PHt @ inverse_covariance(S)
            posterior = P - gain @ PHt.T
            about, (dx, posterior) = (
                dx,
                within_limits(gain @ innovation, posterior, prior.angles, self._low, self._high),
            )
            denied = (1.0 - learned) * dx[PERSON]
            if prior.dt_s > 0.0:
                dx[PERSON] -= denied
            else:
                # One sample cannot tell a patch or paint that sits elsewhere from fingers that are off their mean, so
                # the hand is taken as under what was learned.
                dx -= posterior[:, PERSON] @ np.linalg.solve(posterior[PERSON, PERSON], denied)
            at = self.moved(prior, dx)
            # Steps end when the derivatives were taken this near to where they led.
            if np.abs((dx - about)[_TURNS]).max() < 0.05:
                break
        kept = (1.0 - learned) ** 2
        posterior[PERSON, PERSON] = kept * prior.P[PERSON, PERSON] + (1.0 - kept) * posterior[PERSON, PERSON]
        return dataclasses.replace(
            at,
            angles=self.clamp(at.angles),
            P=0.5 * (posterior + posterior.T),
            prior_covariance=P,
            mean_residual_m=mean_residual_m(rows, (innovation - H @ dx)[:15].reshape(5, 3), _MISS_M),
        )

    def cost(self, state: HandState, evidence: Evidence) -> float:
        """Return how ill a state explains a sample on its own: squared errors over their variances, angles included."""
        seen = np.isfinite(evidence.tips).all(axis=1)
        off = state.angles - self._rest
        cost = float(off @ self._stationary_inverse @ off)
        cost += float(state.person @ self._person_inverse @ state.person)
        tips, _ = self._kinematics.markers(state.angles, state.person[_LENGTHS])
        missed = (evidence.tips - state.p - tips @ state.R.T)[seen]
        inverse = np.linalg.inv(evidence.tip_covariances[seen])
        cost += float((missed[:, None] @ inverse @ missed[:, :, None]).sum())
        if np.isfinite(evidence.base[0]):
            gap = evidence.base - state.p - state.R @ (self._base_offset + state.person[_SHIFT])
            cost += float(gap @ np.linalg.solve(evidence.base_covariance, gap))
        if evidence.rotation is not None:
            turn = vector_from_rotation(self.patch_rotation(state).T @ evidence.rotation)
            cost += squared_distance(turn, evidence.rotation_covariance)
        if evidence.patch is not None:
            cost += evidence.patch.misfit
        return cost

    @staticmethod
    def moved(prior: HandState, dx: FloatArray) -> HandState:
        """Return a state that is off another by an error (43,)."""
        return HandState(
            prior.R @ rotation_from_vector(dx[ROTATION]),
            prior.p + dx[POSITION],
            prior.angular_velocity + dx[ANGULAR_VELOCITY],
            prior.velocity + dx[VELOCITY],
            prior.angles + dx[ANGLES],
            prior.person + dx[PERSON],
            prior.P,
            prior.dt_s,
            prior.keeps,
        )

    def clamp(self, angles: FloatArray) -> FloatArray:
        """Return angles (20,), radians, clamped to the limits."""
        inside: FloatArray = np.minimum(np.maximum(angles, self._low), self._high)
        return inside

    def _is_far(self, prior: HandState, rows: Rows, expected: FloatArray) -> bool:
        """Tell whether any seen tip lies so far from the expected ones (5, 3) that derivatives there say little."""
        off = (rows.points[:5] - prior.p) @ prior.R - expected
        # A tip further than this from where it was expected is first looked for in closed form.
        return bool((np.abs(off) * rows.seen[:5, None]).max() > 0.015)

    def scaled_to_model(self, local: FloatArray, longer: FloatArray) -> FloatArray:
        """Return points (5, 3), wrist frame, metres, scaled about the knuckles to fingers of the model's lengths."""
        knuckles = self._model.knuckles
        scaled: FloatArray = knuckles + (local - knuckles) / (1.0 + longer)[:, None]
        return scaled

    def _closed_form(self, prior: HandState, rows: Rows) -> FloatArray:
        """Return the angles (20,) to linearise about: where the seen tips put their fingers under the expected palm."""
        seen = rows.seen[:5, None]
        local = np.where(seen, self.scaled_to_model((rows.points[:5] - prior.p) @ prior.R, prior.longer), self._resting)
        angles: FloatArray = np.where(seen, self._fingers.solve(local).angles, prior.angles.reshape(5, 4))
        return angles.reshape(COUNT)

    def _linearise(
        self, rows: Rows, at: HandState, modelled: tuple[FloatArray, FloatArray]
    ) -> tuple[FloatArray, FloatArray]:
        """Return H (21, 43) and what was measured beyond what a pose has, (21,); rows of what was not seen are 0.

        `modelled` are the markers and their derivatives as `HandKinematics.markers` has them.
        """
        tips, J = modelled
        R = at.R
        arms = np.empty((6, 3))
        arms[:5], arms[5] = tips, self._base_offset + at.person[_SHIFT]
        arms = arms @ R.T
        y = np.zeros(_ROWS)
        y[:18] = (rows.points - at.p - arms).reshape(-1)
        H = self._H.copy()
        # d(R·exp(δθ)·m) = −R·[m]×·δθ = −[R·m]×·R·δθ
        H[:18, ROTATION] = cross_matrix(arms).reshape(18, 3) @ -R
        H.reshape(-1)[_OWN] = R @ J
        H[15:18, BASE_SHIFT] = R
        if rows.rotation is not None:
            tilt = rotation_from_vector(at.person[_TILT])
            y[18:] = vector_from_rotation((R @ tilt).T @ rows.rotation)
            H[18:, ROTATION] = tilt.T
        return (H, y) if rows.all_seen else (H * rows.counts[:, None], y * rows.counts)

    def _inflated(
        self, prior: HandState, rows: Rows, H: FloatArray, innovation: FloatArray
    ) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
        """Return P inflated for hands that move faster than usual, P·Hᵀ, H·P·Hᵀ and the noise (7, 3, 3).

        The noise of a patch's rotation that is an outlier is raised.
        """
        PHt = prior.P @ H.T
        S = H @ PHt
        own = S.reshape(7, 3, 7, 3)[_BLOCKS, :, _BLOCKS] + rows.noise
        nis = np.array(squared_distances(innovation.reshape(7, 3), own)) * rows.seen
        P, noise = prior.P, rows.noise
        unlikely = nis[6] / _TURN_OUTLIER**2
        if unlikely > 1.0:
            noise = noise.copy()
            noise[6] *= unlikely**2
        nis = nis[:5] / 3.0
        if prior.keeps is not None and float(nis.max()) > 1.0:
            times = np.sqrt(np.minimum(np.maximum(nis, 1.0), _MOST_ACTIVITY) - 1.0)
            times = np.where(rows.seen[:5], times, times[rows.seen[:5]].mean())
            P = prior.P.copy()
            room = self.diffused(prior.keeps, np.repeat(times, 4))
            P[ANGLES, ANGLES] += room
            PHt[ANGLES] += room @ H[:, ANGLES].T
            S = H @ PHt
        return P, PHt, S, noise

    def _downweighted(
        self, rows: Rows, noise: FloatArray, y: FloatArray, by_pose: FloatArray | None, P: FloatArray
    ) -> FloatArray:
        """Return the noise (7, 3, 3), raised for tips that no pose within the joint limits explains.

        Where the derivatives by the wrist's pose `by_pose` (15, 6) are given, only the fingers were brought to the tips
        by now, and the pose may account for as much of what is missed as its covariance P (6, 6) says.
        """
        missed = y[:15].reshape(5, 3)
        allowed = rows.noise[:5] + _MISS_M**2 * _UNIT
        if by_pose is not None:
            allowed = allowed + (by_pose @ P @ by_pose.T).reshape(5, 3, 5, 3)[_TIPS, :, _TIPS]
        share = np.array(squared_distances(missed, allowed))
        doubted = noise.copy()
        # A tip further off than any model's error loses next to all of its weight.
        doubted[:5] *= (1.0 + share)[:, None, None]
        doubted[:5] += (_MISS_M**2 * np.maximum(0.0, share - 1.0))[:, None, None] * _UNIT
        return doubted

    def tips(self, state: HandState) -> FloatArray:
        """Return the markers (5, 3), metres, rig frame, as a state has them."""
        local, _ = self._kinematics.markers(state.angles, state.longer)
        placed: FloatArray = local @ state.R.T + state.p
        return placed
