"""The palm: where the wrist is and how it is turned, from the marker on its back and from the fingertips.

Position. The base marker is trusted: wrist = base − R · (offset of the base marker in the wrist frame), so translation
follows without lag.

Rotation. What one sample says about R is a least-squares problem in three unknowns, each term divided by its own
standard deviation:

- the corners of the base patch, where the cameras saw them, against its known rectangle;
- each fingertip through the finger's closed form: it must be within reach (limits of the joints), should lie near the
  plane in which its finger bends without abduction, and its knuckle should bend about as much as its curl suggests;
- without corners, weakly: the back of the hand faces the cameras (−z of the rig);
- the rotation that constant turning from the last sample predicts.

A few Gauss–Newton steps from the prediction solve it (numerical derivatives, all in one batched evaluation), with a
bound on how far one sample may turn the palm. At the start, the best of several guesses around the direction from the
base to the fingertips is taken.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from rhot.rotations import nearest_rotation, rotation_from_vector, rotation_x, rotation_z, vector_from_rotation
from rhot_ik.finger_geometry import FingerGeometry
from rhot_ik.fingers import AnalyticFingers

FloatArray = NDArray[np.float64]

SIGMA_REACH_M: Final = 0.004
SIGMA_LATERAL_RAD: Final = np.radians([25.0, 7.0, 4.0, 7.0, 9.0])
"""Spread of the abduction of a hand at ease, per finger."""
SIGMA_LATERAL_M: Final = 0.003
SIGMA_FLEXION_RAD: Final = np.radians([50.0, 40.0, 40.0, 40.0, 40.0])
FLEXION_AT_REST_RAD: Final = np.radians([5.0, 10.0, 10.0, 10.0, 10.0])
FLEXION_PER_CURL: Final = np.array([0.2, 0.5, 0.5, 0.5, 0.5])
"""A knuckle bends about this much more when the finger curls: expected flexion = at rest + per curl · PIP."""
SIGMA_CORNER_M: Final = 0.002
MAX_CORNER_ERROR_M: Final = 0.006
SIGMA_BACK: Final = 1.5
TURN_RAD_PER_SQRT_S: Final = 0.7
"""Random walk of the palm's rotation about what constant turning predicts."""
MAX_TURN_RAD_S: Final = 10.0
VELOCITY_GAIN: Final = 0.1
VELOCITY_DECAY_S: Final = 0.15
_DIFFERENCE_RAD: Final = 1e-3
_SATURATION: Final = 4.0


@dataclass(frozen=True, slots=True)
class PalmEvidence:
    """What one sample says about the palm, rig frame, metres.

    Attributes:
        base: (3,) centre of the base marker.
        corners: (4, 3) corners of its patch in cyclic order from an unknown one, or none seen.
        tips: (5, 3) fingertip markers; NaN rows = not seen.
        weights: (5,) trust in each tip, 0 to 1; 0 where not seen.
    """

    base: FloatArray
    corners: FloatArray | None
    tips: FloatArray
    weights: FloatArray


class PalmEstimator:
    """Estimates the palm's rotation sample by sample.

    Args:
        geometry: the hand.
        base_offset: (3,) metres: the base marker's centre in the wrist frame.
        outline: (4, 3) metres: corners of its patch about its centre, wrist frame; none for a round marker.
    """

    def __init__(self, geometry: FingerGeometry, base_offset: FloatArray, outline: FloatArray | None) -> None:
        self._fingers = AnalyticFingers(geometry)
        self._neutral = geometry.marker_points(geometry.model.clamp(np.zeros((5, 4))))
        self._base_offset = base_offset
        self._outline = outline
        self._rotation: FloatArray | None = None
        self._turning = np.zeros(3)

    @property
    def rotation(self) -> FloatArray | None:
        """(3, 3) of the last sample, wrist to rig; none before the first."""
        return self._rotation

    def reset(self) -> None:
        """Forget everything."""
        self._rotation = None
        self._turning = np.zeros(3)

    def wrist(self, base: FloatArray, rotation: FloatArray) -> FloatArray:
        """Return the wrist (3,), metres, rig frame, under a base marker at `base` (3,)."""
        position: FloatArray = base - rotation @ self._base_offset
        return position

    def base(self, T_rig_wrist: FloatArray) -> FloatArray:
        """Return where the base marker (3,) of a wrist pose is, metres, rig frame; inverts `wrist`."""
        position: FloatArray = T_rig_wrist[:3, 3] + T_rig_wrist[:3, :3] @ self._base_offset
        return position

    def update(self, evidence: PalmEvidence, dt_s: float) -> FloatArray | None:
        """Return the rotation (3, 3), wrist to rig, after one more sample.

        Args:
            evidence: of this sample.
            dt_s: seconds since the last one, not negative.

        Returns:
            None while nothing was known before and no fingertip is seen.
        """
        if self._rotation is None:
            self._rotation = self._first(evidence)
            return self._rotation
        predicted = self._rotation @ rotation_from_vector(self._turning * dt_s)
        corners = self._matched_corners(evidence.corners, predicted)
        sigma = max(TURN_RAD_PER_SQRT_S * np.sqrt(dt_s), 1e-4)
        found = self._descend(evidence, corners, predicted, sigma, steps=2)
        turn = vector_from_rotation(predicted.T @ found)
        most = max(MAX_TURN_RAD_S * dt_s, 1e-6)
        size = float(np.sqrt(turn @ turn))
        if size > most:
            turn *= most / size
            found = predicted @ rotation_from_vector(turn)
        if dt_s > 0.0:
            gained = self._turning + VELOCITY_GAIN * turn / max(dt_s, 1e-3)
            self._turning = gained * np.exp(-dt_s / VELOCITY_DECAY_S)
            speed = float(np.sqrt(self._turning @ self._turning))
            self._turning *= min(1.0, MAX_TURN_RAD_S / 2.0 / max(speed, 1e-9))
        self._rotation = nearest_rotation(found)
        return self._rotation

    def _first(self, evidence: PalmEvidence) -> FloatArray | None:
        seen = evidence.weights > 0.0
        if not seen.any():
            return None
        direction = evidence.tips[seen].mean(axis=0) - evidence.base
        if direction @ direction < 1e-6:
            return None
        back = direction / -np.sqrt(direction @ direction)
        up = np.array([0.0, 0.0, -1.0])
        if abs(up @ back) > 0.95:
            up = np.array([0.0, -1.0, 0.0])
        side = np.cross(up, back)
        side /= np.sqrt(side @ side)
        towards_tips = np.column_stack([side, np.cross(back, side), back])
        # The tips usually hang below the plane of the palm, so the palm is pitched up from their direction.
        guesses = [
            towards_tips @ rotation_x(np.radians(pitch)) @ rotation_z(np.radians(roll))
            for pitch in (0.0, 25.0, 50.0)
            for roll in (-40.0, 0.0, 40.0)
        ]
        best, best_cost = guesses[0], np.inf
        for guess in guesses:
            rotation = self._descend(evidence, None, guess, np.radians(90.0), steps=6)
            corners = self._matched_corners(evidence.corners, rotation)
            if corners is not None:
                rotation = self._descend(evidence, corners, rotation, np.radians(90.0), steps=4)
            cost = float((self._residuals(rotation[None], evidence, corners)[0] ** 2).sum())
            if cost < best_cost:
                best, best_cost = rotation, cost
        return nearest_rotation(best)

    def _descend(
        self, evidence: PalmEvidence, corners: FloatArray | None, start: FloatArray, sigma_rad: float, steps: int
    ) -> FloatArray:
        """Return the rotation (3, 3) after some Gauss–Newton steps from `start`, held to it with `sigma_rad`."""
        rotation, moved = start, np.zeros(3)
        prior = 1.0 / sigma_rad**2
        trial = np.empty((4, 3, 3))
        for _ in range(steps):
            trial[0] = rotation
            trial[1:] = rotation @ _DIFFERENCES
            values = self._residuals(trial, evidence, corners)
            J = (values[1:] - values[0]) / _DIFFERENCE_RAD
            hessian = J @ J.T + np.eye(3) * (prior + 1e-6)
            step = -np.linalg.solve(hessian, J @ values[0] + prior * moved)
            size = float(np.sqrt(step @ step))
            step *= min(1.0, 0.35 / max(size, 1e-9))
            rotation = rotation @ rotation_from_vector(step)
            moved = moved + step
            if size < 1e-4:
                break
        return rotation

    def _residuals(self, rotations: FloatArray, evidence: PalmEvidence, corners: FloatArray | None) -> FloatArray:
        """Return residuals (K, M) of candidate rotations (K, 3, 3), each in units of its standard deviation."""
        seen = (evidence.weights > 0.0)[:, None]
        arms = np.where(seen, evidence.tips - evidence.base, 0.0)
        targets = np.where(seen, arms @ rotations + self._base_offset, self._neutral)
        pose = self._fingers.solve(targets)
        weights = np.sqrt(evidence.weights)
        miss = pose.miss / SIGMA_REACH_M
        # One wild tip must not turn the whole palm: residuals saturate.
        miss = miss / np.sqrt(1.0 + (miss**2).sum(-1, keepdims=True) / _SATURATION**2) * weights[:, None]
        # Weights are taken from the first candidate so that they do not enter the derivative.
        spread = np.sqrt(SIGMA_LATERAL_M**2 + (SIGMA_LATERAL_RAD * pose.depth[0]) ** 2)
        lateral = pose.lateral / spread
        lateral = lateral / np.sqrt(1.0 + (lateral / _SATURATION) ** 2) * weights
        expected = FLEXION_AT_REST_RAD + FLEXION_PER_CURL * pose.angles[..., 2]
        flexion = (pose.free_flexion - expected) / SIGMA_FLEXION_RAD
        flexion = flexion / np.sqrt(1.0 + (flexion / _SATURATION) ** 2) * weights
        count = len(rotations)
        parts = [miss.reshape(count, -1), lateral, flexion]
        if corners is not None and self._outline is not None:
            modelled = self._outline @ np.swapaxes(rotations, -1, -2)
            parts.append(((modelled - corners) / SIGMA_CORNER_M).reshape(count, -1))
        else:
            parts.append((rotations[:, :, 1] + (0.0, 0.0, 1.0)) / SIGMA_BACK)
        return np.concatenate(parts, axis=1)

    def _matched_corners(self, corners: FloatArray | None, rotation: FloatArray) -> FloatArray | None:
        """Return corners (4, 3) about their centre in the order of the outline, or none if they are no such patch.

        Of the eight ways to go round a rectangle, the one nearest to `rotation` is right: it is turned by far less
        than a quarter from the truth.
        """
        if corners is None or self._outline is None or not np.isfinite(corners).all():
            return None
        centred = corners - corners.mean(axis=0)
        wanted = self._outline @ rotation.T
        orders = centred[_ORDERS]
        best = orders[np.argmin(((orders - wanted) ** 2).sum((1, 2)))]
        fitted = nearest_rotation(best.T @ self._outline)
        error = np.sqrt(((best - self._outline @ fitted.T) ** 2).sum(axis=1).mean())
        return best if error <= MAX_CORNER_ERROR_M else None


_DIFFERENCES: Final = np.stack([rotation_from_vector(axis * _DIFFERENCE_RAD) for axis in np.eye(3)])
_ORDERS: Final = np.array([[(first + way * k) % 4 for k in range(4)] for way in (1, -1) for first in range(4)])
