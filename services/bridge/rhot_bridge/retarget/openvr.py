"""Converts OpenXR's joints to the 31 bones of OpenVR's hand skeleton.

With R_j the rotation of an OpenXR joint, a bone's rotation is R'_j = R_j · C⁻¹ and the wrist's R'_w = R_w · D⁻¹:

    left   C: v' = (−z, −y, −x)    D: v' = ( y,  x, −z)       a finger points along +x
    right  C: v' = ( z,  y, −x)    D: v' = (−y, −x, −z)       a finger points along −x

so that in the parent's axes, with Q_j = R_parent⁻¹ · R_j and t_j the joint's position in the parent's OpenXR axes,

    metacarpals   D · Q_j · C⁻¹, at D · t_j          (D · C⁻¹ is the quaternion (½, −½, ½, ½), right (−½, ½, ½, ½))
    the others    C · Q_j · C⁻¹, at C · t_j          ((±length, 0, 0): + left, − right)
    wrist         D⁻¹ in the device's axes, which are those of OpenXR's wrist

C and D are rotations, for either hand. Bones: 0 root, 1 wrist, 2–25 OpenXR's joints, 26–30 the distal joints of thumb
to little finger again, in the device's axes.
"""

from __future__ import annotations

from collections.abc import Mapping
from functools import cache
from typing import Final

import numpy as np
from numpy.typing import NDArray

from rhot.anatomy.hand import METACARPALS, WRIST
from rhot.anatomy.skeleton import FINGERS, JOINTS, PARENTS
from rhot.arrays import FloatArray
from rhot.geometry.rotations import product_matrix, quaternion_from_rotation, rotation_from_quaternion
from rhot.messages import Side
from rhot_bridge.retarget.vrm import relative, right_product
from rhot_bridge.scene import BridgedHand

BONES: Final = 31
_C: Final[dict[Side, FloatArray]] = {
    "left": np.array([[0.0, 0.0, -1.0], [0.0, -1.0, 0.0], [-1.0, 0.0, 0.0]]),
    "right": np.array([[0.0, 0.0, 1.0], [0.0, 1.0, 0.0], [-1.0, 0.0, 0.0]]),
}
_D: Final[dict[Side, FloatArray]] = {
    "left": np.array([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, -1.0]]),
    "right": np.array([[0.0, -1.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 0.0, -1.0]]),
}
_FINGER_JOINTS: Final = np.arange(2, len(JOINTS))
_PARENT_ROWS: Final = np.array([JOINTS.index(PARENTS[JOINTS[row]] or "wrist") for row in _FINGER_JOINTS])
_LAST: Final = np.array([JOINTS.index(f"{finger}_distal") for finger in FINGERS])


_ORDER: Final = np.array([2, 1, 0, 3])
_SIGNS: Final[dict[Side, FloatArray]] = {
    "left": np.array([-1.0, -1.0, -1.0, 1.0]),
    "right": np.array([1.0, 1.0, -1.0, 1.0]),
}
"""C · Q · C⁻¹ as a quaternion: right (z, y, −x, w), left (−z, −y, −x, w)."""
_BEFORE: Final = {side: product_matrix(*quaternion_from_rotation(_D[side] @ _C[side].T).tolist()).T for side in _C}
_AFTER: Final = {side: right_product(quaternion_from_rotation(_C[side].T)[None])[0] for side in _C}
_WRIST: Final = {side: quaternion_from_rotation(_D[side].T) for side in _D}


@cache
def _tables(number: int) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Return the rows of the finger joints and of their parents in the concatenated joints of several hands."""
    starts = [len(JOINTS) * hand for hand in range(number)]
    return (
        np.concatenate([_FINGER_JOINTS + start for start in starts]),
        np.concatenate([_PARENT_ROWS + start for start in starts]),
    )


def openvr_bones(hands: Mapping[Side, BridgedHand]) -> FloatArray:
    """Return the bones of hands in their parents' axes.

    Both hands are computed together: with arrays this small, the number of numpy calls determines the time.

    Args:
        hands: one or both, in stage axes, which are OpenVR's; each bone lies along its joint's z.

    Returns:
        (hands, 31, 7): positions, metres, and quaternions, x y z w.
    """
    rows, parents = _tables(len(hands))
    q = np.concatenate([hand.orientations for hand in hands.values()])
    p = np.concatenate([hand.positions for hand in hands.values()])
    offsets = p[rows] - p[parents]
    lengths = np.sqrt((offsets * offsets).sum(axis=1)).reshape(-1, 24)
    rotations = relative(q[parents], q[rows])[:, _ORDER].reshape(-1, 24, 4)
    bones = np.zeros((len(hands), BONES, 7))
    bones[:, 0, 6] = 1.0
    for own, length, rotation, (side, hand) in zip(bones, lengths, rotations, hands.items(), strict=True):
        to_wrist = rotation_from_quaternion(hand.orientations[WRIST])
        from_wrist = (hand.positions - hand.positions[WRIST]) @ to_wrist
        own[1, 3:] = _WRIST[side]
        own[2:26, 0] = length if side == "left" else -length
        own[2:26, 3:] = rotation * _SIGNS[side]
        own[METACARPALS, :3] = from_wrist[METACARPALS] @ _D[side].T
        own[METACARPALS, 3:] = own[METACARPALS, 3:] @ _BEFORE[side]
        own[26:, :3] = from_wrist[_LAST]
        own[26:, 3:] = relative(hand.orientations[WRIST], hand.orientations[_LAST]) @ _AFTER[side]
    return bones
