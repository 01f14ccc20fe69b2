"""Forward kinematics of all five fingers at once, with derivatives, in as few array operations as possible.

In a finger's rest frame the axes of its three bones are, with abduction a and bend b (flexion summed up to the bone),
x = (cos a, 0, −sin a), y = (−sin b·sin a, cos b, −sin b·cos a), z = (cos b·sin a, sin b, cos b·cos a). Every joint, the
marker and its derivatives are fixed combinations of these seven vectors, for ∂z/∂b = y, ∂y/∂b = −z, and abduction turns
all of them about Y. So they are one fixed matrix times the sines and cosines of a finger and their products.
`rhot.anatomy.hand` holds the model itself; this is the same mapping, made for the filter.
"""

from __future__ import annotations

from typing import Final

import numpy as np

from rhot.anatomy.hand import MOVING
from rhot.anatomy.skeleton import JOINTS
from rhot.arrays import FloatArray
from rhot.geometry.rotations import product_matrix, quaternion_from_rotation
from rhot_ik.hand.closed_form import FingerGeometry

_Z: Final = (0, 1, 2)
_Y: Final = (3, 4, 5)
_X: Final = 6
_VECTORS: Final = 7
_TERMS: Final = 20
_MOVING_BONES: Final = MOVING[:, :3].reshape(15)
_MOVING_ENDS: Final = MOVING[:, 1:].reshape(15)
_TIPS: Final = MOVING[:, 3].copy()


class HandKinematics:
    """The chains of one hand; stateless after construction."""

    def __init__(self, geometry: FingerGeometry) -> None:
        model = geometry.model
        self._knuckles, self._all_knuckles = model.knuckles, model.knuckles[:, None]
        self._turns = _turns(model.handedness)
        vectors = _vectors()
        to_palm = np.einsum("fij,vjt->fvit", model.frames, vectors)
        marker = np.zeros((5, _VECTORS))
        marker[:, _Z[:2]] = -model.bones[:, :2]
        marker[:, (_X, _Y[2], _Z[2])] = geometry.ends
        joints = np.zeros((5, 3, _VECTORS))
        for place in range(3):
            joints[:, place, : place + 1] = -model.bones[:, : place + 1]
        self._marker = np.einsum("fv,fvit->fit", marker, to_palm)
        self._chain = np.concatenate(
            [np.einsum("fkv,fvit->fkit", joints, to_palm).reshape(5, 9, _TERMS), self._marker], axis=1
        )
        by_angles = _by_angles(marker, model.frames, model.handedness)
        derivatives = np.concatenate([by_angles, self._marker[:, :, None]], axis=2)
        self._marker_and_derivatives = np.concatenate([self._marker, derivatives.reshape(5, 15, _TERMS)], axis=1)
        ends = [_by_angles(joints[:, place], model.frames, model.handedness) for place in range(3)]
        self._ends_by_angles = np.stack(ends, axis=1).reshape(5, 36, _TERMS)
        # The derivative by the length is the marker of a finger of the model's length.
        self._longer = np.array([1.0, 1.0, 1.0, *([1.0, 1.0, 1.0, 1.0, 0.0] * 3)])
        rest = model.forward_local(np.zeros((5, 4)))
        self._positions, self._orientations = rest.positions, quaternion_from_rotation(rest.rotations)
        # Abduction about y, then bends about −x, of the products of the half angles' sines and cosines.
        bent = np.zeros((4, 4))
        bent[(1, 2, 0, 3), (0, 1, 2, 3)] = -1.0, 1.0, 1.0, 1.0
        in_frames = [product_matrix(*quaternion_from_rotation(frame)) for frame in model.frames]
        self._bent = bent @ np.swapaxes(np.array(in_frames), 1, 2)

    def markers(self, q: FloatArray, longer: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return the markers (5, 3), metres, wrist frame, and their derivatives (5, 3, 5) by angles and length.

        Args:
            q: (20,) radians, finger by finger.
            longer: (5,) by which share each finger is longer than the model's.
        """
        found: FloatArray = (self._marker_and_derivatives @ self._terms(q))[..., 0]
        found *= 1.0 + longer[:, None] * self._longer
        return found[:, :3] + self._knuckles, found[:, 3:].reshape(5, 3, 5)

    def marker_points(self, q: FloatArray) -> FloatArray:
        """Return the markers (5, 3), metres, wrist frame, of a hand of the model's lengths at angles (20,)."""
        points: FloatArray = (self._marker @ self._terms(q))[..., 0] + self._knuckles
        return points

    def chains(self, q: FloatArray, longer: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return the joints that move with each finger, wrist frame, and how.

        Args:
            q: (20,) radians, finger by finger.
            longer: (5,) by which share each finger is longer than the model's.

        Returns:
            Both hinges and the tip (5, 3, 3), metres, and their derivatives (5, 3, 3, 5) by the finger's own four
            angles and its length.
        """
        terms = self._terms(q)
        from_knuckles = (self._chain[:, :9] @ terms).reshape(5, 3, 3)
        stretched = (1.0 + longer)[:, None, None]
        derivatives = np.empty((5, 3, 3, 5))
        derivatives[..., :4] = (self._ends_by_angles @ terms).reshape(5, 3, 3, 4) * stretched[..., None]
        derivatives[..., 4] = from_knuckles
        return self._all_knuckles + from_knuckles * stretched, derivatives

    def joint_derivatives(self, q: FloatArray, longer: FloatArray) -> FloatArray:
        """Return the derivatives (26, 3, 25) of all joints' positions, wrist frame, by angles and fingers' lengths.

        Args:
            q: (20,) radians, finger by finger.
            longer: (5,) by which share each finger is longer than the model's.
        """
        _, moved = self.chains(q, longer)
        derivatives = np.zeros((len(JOINTS), 3, 25))
        for finger, ends in enumerate(MOVING[:, 1:]):
            derivatives[ends, :, 4 * finger : 4 * finger + 4] = moved[finger, ..., :4]
            derivatives[ends, :, 20 + finger] = moved[finger, ..., 4]
        return derivatives

    def pose(
        self, R: FloatArray, p: FloatArray, q: FloatArray, longer: FloatArray
    ) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Return the hand in the rig frame, with its wrist at R (3, 3), p (3,).

        Args:
            R, p: wrist to rig, metres.
            q: (20,) radians, finger by finger.
            longer: (5,) by which share each finger is longer than the model's.

        Returns:
            Positions (26, 3), metres, and unit quaternions (26, 4), x y z w, of all joints, and the markers (5, 3).
        """
        chain = (self._chain @ self._terms(q)).reshape(5, 4, 3) * (1.0 + longer)[:, None, None]
        chain += self._all_knuckles
        positions = self._positions.copy()
        positions[_MOVING_ENDS] = chain[:, :3].reshape(15, 3)
        bent = _products(_circular(0.5 * (self._turns @ q))).reshape(5, 3, 4) @ self._bent
        orientations = self._orientations.copy()
        orientations[_MOVING_BONES], orientations[_TIPS] = bent.reshape(15, 4), bent[:, 2]
        orientations = orientations @ product_matrix(*quaternion_from_rotation(R)).T
        return positions @ R.T + p, orientations, chain[:, 3] @ R.T + p

    def _terms(self, q: FloatArray) -> FloatArray:
        """Return what all is made of, (5, 20, 1): products of a bend's with the abduction's, then all by themselves."""
        circular = _circular(self._turns @ q)
        terms = np.empty((5, _TERMS, 1))
        terms[:, :12, 0] = _products(circular).reshape(5, 12)
        terms[:, 12:, 0] = circular.reshape(5, 8)
        return terms


def _circular(turns: FloatArray) -> FloatArray:
    """Return sines and cosines (20, 2) of turns (20,)."""
    circular = np.empty((20, 2))
    np.sin(turns, circular[:, 0])
    np.cos(turns, circular[:, 1])
    return circular


def _products(circular: FloatArray) -> FloatArray:
    """Return sine, cosine of three bends times sine, cosine of the abduction, (5, 3, 2, 2), from those of all turns."""
    by_finger = circular.reshape(5, 4, 2)
    products: FloatArray = by_finger[:, 1:, :, None] * by_finger[:, :1, None, :]
    return products


def _turns(handedness: float) -> FloatArray:
    """Return the matrix (20, 20) from angles to abduction and three bends of each finger."""
    turns = np.zeros((20, 20))
    for finger in range(5):
        flexion, abduction, middle, last = range(4 * finger, 4 * finger + 4)
        turns[4 * finger, abduction] = handedness
        for bone, hinges in enumerate(((flexion,), (flexion, middle), (flexion, middle, last))):
            turns[4 * finger + 1 + bone, hinges] = 1.0
    return turns


def _by_angles(shares: FloatArray, frames: FloatArray, handedness: float) -> FloatArray:
    """Return the derivatives (5, 3, 4, 20), palm, by `_terms`, of points by flexion, abduction, middle and last hinge.

    Args:
        shares: (5, 7) of z, y of the three bones and their x in each finger's point, metres.
        frames: (5, 3, 3) of the fingers at rest.
        handedness: 1 right, −1 left.
    """
    vectors = _vectors()
    bent = np.zeros((3, 5, _VECTORS))
    for place in range(3):
        # ∂z/∂b = y, ∂y/∂b = −z, of this bone and those after it.
        bent[place][:, _Y[place:]] = shares[:, _Z[place:]]
        bent[place][:, _Z[place:]] = -shares[:, _Y[place:]]
    flexion, middle, last = np.einsum("kfv,fij,vjt->kfit", bent, frames, vectors)
    # ∂/∂a of (x, y, z) is (z, 0, −x).
    about = handedness * np.array([[0.0, 0.0, 1.0], [0.0, 0.0, 0.0], [-1.0, 0.0, 0.0]])
    abduction = np.einsum("fv,fij,jk,vkt->fit", shares, frames, about, vectors)
    return np.stack([flexion, abduction, middle, last], axis=2)


def _vectors() -> FloatArray:
    """Return z, y of the three bones and their common x, (7, 3, 20), in a finger's rest frame, by `_terms`."""
    vectors = np.zeros((_VECTORS, 3, _TERMS))
    for bone in range(3):
        sine_sine, sine_cosine, cosine_sine, cosine_cosine = range(4 * bone, 4 * bone + 4)
        sine, cosine = 14 + 2 * bone, 15 + 2 * bone
        vectors[_Z[bone], (0, 1, 2), (cosine_sine, sine, cosine_cosine)] = 1.0
        vectors[_Y[bone], (0, 1, 2), (sine_sine, cosine, sine_cosine)] = -1.0, 1.0, -1.0
    vectors[_X, (0, 2), (13, 12)] = 1.0, -1.0
    return vectors
