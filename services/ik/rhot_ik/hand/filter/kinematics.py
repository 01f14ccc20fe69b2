"""Forward kinematics of all five fingers at once, with derivatives, in as few array operations as can be.

In a finger's rest frame the axes of its three bones are, with abduction a and bend b (flexion summed up to the bone),
x = (cos a, 0, −sin a), y = (−sin b·sin a, cos b, −sin b·cos a), z = (cos b·sin a, sin b, cos b·cos a). Every joint, the
marker and its derivatives by the three bends are fixed combinations of these seven vectors, for ∂z/∂b = y, ∂y/∂b = −z;
abduction turns all of them about Y. `rhot.anatomy.hand` holds the model itself; this is the same mapping, made for the
filter.
"""

from __future__ import annotations

from typing import Final

import numpy as np

from rhot.anatomy.hand import METACARPALS, MOVING, PALM, WRIST
from rhot.arrays import FloatArray
from rhot.geometry.rotations import product_matrix, quaternion_from_rotation
from rhot_ik.hand.fingers.geometry import FingerGeometry

_Z: Final = (0, 1, 2)
_Y: Final = (3, 4, 5)
_X: Final = 6
_VECTORS: Final = 7
_CARPAL: Final = np.array([WRIST, *METACARPALS[1:]])
"""Joints that stand still in the wrist; the thumb's first joint, which moves, is known by what it moves."""


class HandKinematics:
    """The chains of one hand; stateless after construction."""

    def __init__(self, geometry: FingerGeometry) -> None:
        model = geometry.model
        self._handedness = model.handedness
        self._frames_t = np.ascontiguousarray(np.swapaxes(model.frames, 1, 2))
        self._knuckles = model.knuckles
        bones, ends = model.bones, geometry.ends
        # From 20 angles to five abductions and three bends of each finger.
        self._sums = np.zeros((20, 20))
        for finger in range(5):
            flexion, abduction, middle, last = range(4 * finger, 4 * finger + 4)
            self._sums[finger, abduction] = self._handedness
            for bone, hinges in enumerate(((flexion,), (flexion, middle), (flexion, middle, last))):
                self._sums[5 + 3 * finger + bone, hinges] = 1.0
        marker = np.zeros((5, 1, _VECTORS))
        marker[:, 0, _Z[:2]] = -bones[:, :2]
        marker[:, 0, (_X, _Y[2], _Z[2])] = ends
        by_bends = np.zeros((5, 3, _VECTORS))
        for place in range(3):
            by_bends[:, place, _Y[place:]] = marker[:, 0, _Z[place:]]
            by_bends[:, place, _Z[2]] = -ends[:, 1]
        joints = np.zeros((5, 3, _VECTORS))
        for place in range(3):
            joints[:, place, : place + 1] = -bones[:, : place + 1]
        self._marker = np.concatenate([marker, by_bends], axis=1)
        self._chain = np.concatenate([joints, marker], axis=1)
        rest = model.forward_local(np.zeros((5, 4)))
        self._positions, self._orientations = rest.positions, quaternion_from_rotation(rest.rotations)
        in_frames = [product_matrix(*quaternion_from_rotation(frame)) for frame in model.frames]
        self._in_frames_t = np.ascontiguousarray(np.swapaxes(np.array(in_frames), 1, 2))

    def markers(self, q: FloatArray, longer: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return the markers (5, 3), metres, wrist frame, and their derivatives (5, 3, 5) by angles and length.

        Args:
            q: (20,) radians, finger by finger.
            longer: (5,) by which share each finger is longer than the model's.
        """
        found = self._marker @ self._vectors(q)
        rows = np.empty((5, 6, 3))
        rows[:, 0], rows[:, 1], rows[:, 3:5], rows[:, 5] = found[:, 0], found[:, 1], found[:, 2:], found[:, 0]
        # ∂/∂a of (x, y, z) is (z, 0, −x).
        rows[:, 2, 0] = self._handedness * found[:, 0, 2]
        rows[:, 2, 1] = 0.0
        rows[:, 2, 2] = -self._handedness * found[:, 0, 0]
        rows[:, :5] *= (1.0 + longer)[:, None, None]
        rows = rows @ self._frames_t
        return rows[:, 0] + self._knuckles, rows[:, 1:].swapaxes(1, 2)

    def pose(
        self, R: FloatArray, p: FloatArray, q: FloatArray, longer: FloatArray, shorter_palm_m: float = 0.0
    ) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Return the hand in the rig frame, with its wrist at R (3, 3), p (3,).

        Args:
            R, p: wrist to rig, metres.
            q: (20,) radians, finger by finger.
            longer: (5,) by which share each finger is longer than the model's.
            shorter_palm_m: by how much the wrist lies nearer to the knuckles than the model has it; R, p are those of
                the wrist as the model has it.

        Returns:
            Positions (26, 3), metres, and unit quaternions (26, 4), x y z w, of all joints, and the markers (5, 3).
        """
        chain = (self._chain @ self._vectors(q)) @ self._frames_t * (1.0 + longer)[:, None, None]
        chain += self._knuckles[:, None]
        positions, orientations = self._positions.copy(), self._orientations.copy()
        positions[MOVING[:, 1:]] = chain[:, :3]
        positions[_CARPAL, 2] -= shorter_palm_m
        positions[PALM, 2] -= 0.5 * shorter_palm_m
        halves = 0.5 * (self._sums @ q)
        cos, sin = np.cos(halves), np.sin(halves)
        cos_a, sin_a = cos[:5, None], sin[:5, None]
        cos_b, sin_b = cos[5:].reshape(5, 3), sin[5:].reshape(5, 3)
        # Abduction about y, then bends about −x.
        bent = np.empty((5, 3, 4))
        bent[:, :, 0], bent[:, :, 1] = -cos_a * sin_b, sin_a * cos_b
        bent[:, :, 2], bent[:, :, 3] = sin_a * sin_b, cos_a * cos_b
        bent = bent @ self._in_frames_t
        orientations[MOVING[:, :3]] = bent
        orientations[MOVING[:, 3]] = bent[:, 2]
        orientations = orientations @ product_matrix(*quaternion_from_rotation(R)).T
        return positions @ R.T + p, orientations, chain[:, 3] @ R.T + p

    def _vectors(self, q: FloatArray) -> FloatArray:
        """Return z, y of the three bones and their common x, (5, 7, 3), in the fingers' rest frames."""
        turns = self._sums @ q
        cos, sin = np.cos(turns), np.sin(turns)
        cos_a, sin_a = cos[:5, None], sin[:5, None]
        cos_b, sin_b = cos[5:].reshape(5, 3), sin[5:].reshape(5, 3)
        out = np.zeros((5, _VECTORS, 3))
        out[:, :3, 0], out[:, :3, 1], out[:, :3, 2] = cos_b * sin_a, sin_b, cos_b * cos_a
        out[:, 3:6, 0], out[:, 3:6, 1], out[:, 3:6, 2] = -sin_b * sin_a, cos_b, -sin_b * cos_a
        out[:, _X, 0], out[:, _X, 2] = cos[:5], -sin[:5]
        return out
