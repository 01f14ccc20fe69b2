"""From OpenXR's joints to the 31 bones of OpenVR's hand skeleton.

With R_j a joint's axes in OpenXR's sense, a bone's own axes are R'_j = R_j · C⁻¹ and the wrist's R'_w = R_w · D⁻¹:

    left   C: v' = (−z, −y, −x)    D: v' = ( y,  x, −z)       a finger points along +x
    right  C: v' = ( z,  y, −x)    D: v' = (−y, −x, −z)       a finger points along −x

so that in the parent's axes, with Q_j = R_parent⁻¹ · R_j and t_j the joint's position in the parent's OpenXR axes,

    metacarpals   D · Q_j · C⁻¹, at D · t_j          (D · C⁻¹ is the quaternion (½, −½, ½, ½), right (−½, ½, ½, ½))
    the others    C · Q_j · C⁻¹, at C · t_j          ((±length, 0, 0): + left, − right)
    wrist         D⁻¹ in the device's axes, which are those of OpenXR's wrist

C and D are rotations, for either hand. Bones: 0 root, 1 wrist, 2–25 OpenXR's joints, 26–30 the last joints of thumb to
little finger once more, in the device's axes.
"""

from __future__ import annotations

from typing import Final

import numpy as np
from numpy.typing import NDArray

from rhot.anatomy.hand import METACARPALS, WRIST
from rhot.anatomy.skeleton import FINGERS, JOINTS, PARENTS
from rhot.geometry.rotations import product_matrix, quaternion_from_rotation, rotation_from_quaternion
from rhot.messages import Side
from rhot_bridge.retarget.quaternions import relative, right_product
from rhot_bridge.scene import Hand

FloatArray = NDArray[np.float64]

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


def openvr_bones(hand: Hand, side: Side) -> FloatArray:
    """Return the bones of a hand in their parents' axes.

    Args:
        hand: in stage axes, which are OpenVR's; each bone lies along its joint's z.
        side: whose.

    Returns:
        (31, 7): positions, metres, and quaternions, x y z w.
    """
    q, p = hand.orientations, hand.positions
    bones = np.zeros((BONES, 7))
    bones[0, 6] = 1.0
    bones[1, 3:] = _WRIST[side]
    offsets = p[_FINGER_JOINTS] - p[_PARENT_ROWS]
    bones[2:26, 0] = np.sqrt((offsets * offsets).sum(axis=1)) * (1.0 if side == "left" else -1.0)
    bones[2:26, 3:] = relative(q[_PARENT_ROWS], q[_FINGER_JOINTS])[:, _ORDER] * _SIGNS[side]
    to_wrist = rotation_from_quaternion(q[WRIST])
    bones[METACARPALS, :3] = (p[METACARPALS] - p[WRIST]) @ to_wrist @ _D[side].T
    bones[METACARPALS, 3:] = bones[METACARPALS, 3:] @ _BEFORE[side]
    bones[26:, :3] = (p[_LAST] - p[WRIST]) @ to_wrist
    bones[26:, 3:] = relative(q[WRIST], q[_LAST]) @ _AFTER[side]
    return bones
