"""Converts OpenXR's joints to a VRM avatar's bones.

Unity's axes. The rotation of every bone of a VRM avatar is the identity in its T-pose: arms along ∓x, palms down,
thumbs halfway forward. With R_j the rotation of an OpenXR joint (z along the bone to its tip, y out of its back) and
I_j its rotation in the T-pose, a bone is rotated from the T-pose by

    N_j = R_j · I_j⁻¹            and N_parent⁻¹ · N_j is sent.

I_j by its z (along the bone) and y (out of the back): left fingers −x and +y, right fingers +x and +y; left thumb
(−1, 0, 1)/√2 and (1, 0, 1)/√2, right thumb mirrored in x. The bones ThumbProximal, Intermediate and Distal are
OpenXR's thumb metacarpal, proximal and distal; the other metacarpals are fixed in VRM: the hand is the fingers' parent.
Positions are those of the tracked hand, p_sent = N_parent⁻¹ · (p_j − p_parent): some programs would apply zeros.
"""

from __future__ import annotations

from collections.abc import Mapping
from functools import cache
from typing import Final

import numpy as np
from numpy.typing import NDArray

from rhot.anatomy.hand import WRIST
from rhot.anatomy.skeleton import FINGERS, JOINTS
from rhot.arrays import FloatArray
from rhot.geometry.rotations import quaternion_from_rotation, rotation_from_quaternion
from rhot.messages import Side
from rhot_bridge.scene import BridgedHand

# Products of many quaternions, x y z w, in a few numpy calls.

_IDENTITY: Final = np.array([0.0, 0.0, 0.0, 1.0])


def conjugate(xyzw: FloatArray) -> FloatArray:
    """Return the inverse of unit quaternions (..., 4)."""
    inverse: FloatArray = xyzw * np.array([-1.0, -1.0, -1.0, 1.0])
    return inverse


def right_product(xyzw: FloatArray) -> FloatArray:
    """Return the matrices (N, 4, 4) of quaternions r (N, 4) for which q @ matrix = q ⊗ r."""
    x, y, z, w = xyzw.T
    rows = [[w, -z, y, -x], [z, w, -x, -y], [-y, x, w, -z], [x, y, z, w]]
    return np.moveaxis(np.array(rows), -1, 0)


def relative(parents: FloatArray, children: FloatArray) -> FloatArray:
    """Return the quaternions parent⁻¹ ⊗ child (N, 4) of parents (N, 4), or one parent (4,), and children (N, 4)."""
    a, b, c, d = parents.T
    x, y, z, w = children.T
    found = np.empty_like(children)
    found[:, 0] = d * x - a * w - b * z + c * y
    found[:, 1] = d * y + a * z - b * w - c * x
    found[:, 2] = d * z - a * y + b * x - c * w
    found[:, 3] = d * w + a * x + b * y + c * z
    return found


def faded(quaternions: FloatArray, weight: float) -> FloatArray:
    """Return rotations (..., 4) interpolated towards the identity as the weight falls from 1 to 0."""
    if weight >= 1.0:
        return quaternions
    near = np.where(quaternions[..., 3:] < 0.0, -quaternions, quaternions)
    mixed = weight * near + (1.0 - weight) * _IDENTITY
    unit: FloatArray = mixed / np.linalg.norm(mixed, axis=-1, keepdims=True)
    return unit


_SEGMENTS: Final = ("Proximal", "Intermediate", "Distal")
_DIAGONAL: Final = np.sqrt(0.5)


def _finger_joints(finger: str) -> tuple[str, str, str]:
    if finger == "thumb":
        return "thumb_metacarpal", "thumb_proximal", "thumb_distal"
    return f"{finger}_proximal", f"{finger}_intermediate", f"{finger}_distal"


FINGER_BONES: Final = tuple(f"{finger.capitalize()}{segment}" for finger in FINGERS for segment in _SEGMENTS)
"""The 15 bones of a hand, without the prefix of the side."""
_ROWS: Final = np.array([JOINTS.index(joint) for finger in FINGERS for joint in _finger_joints(finger)])
_PARENTS: Final = np.array([WRIST if index % 3 == 0 else _ROWS[index - 1] for index in range(15)])


def _axes(y: tuple[float, float, float], z: tuple[float, float, float]) -> FloatArray:
    """Return axes (3, 3) as columns, x = y × z."""
    return np.stack([np.cross(y, z), np.array(y), np.array(z)], axis=1)


def _rest(side: Side) -> FloatArray:
    out = 1.0 if side == "right" else -1.0
    rest = np.tile(_axes((0.0, 1.0, 0.0), (out, 0.0, 0.0)), (len(JOINTS), 1, 1))
    thumb = _axes((-out * _DIAGONAL, 0.0, _DIAGONAL), (out * _DIAGONAL, 0.0, _DIAGONAL))
    rest[[JOINTS.index(joint) for joint in (*_finger_joints("thumb"), "thumb_tip")]] = thumb
    return rest


REST: Final[dict[Side, FloatArray]] = {"left": _rest("left"), "right": _rest("right")}
"""(26, 3, 3) I_j of each joint, Unity's axes."""


_UNREST: Final = {side: right_product(conjugate(quaternion_from_rotation(rest))) for side, rest in REST.items()}
"""(26, 4, 4) matrices: q_j @ _UNREST_j is the quaternion of N_j."""
_BONE_AXIS: Final = {side: rest[_PARENTS] @ np.array([0.0, 0.0, 1.0]) for side, rest in REST.items()}
"""(15, 3) direction of each bone's parent in the T-pose, along which the bone's joint lies."""


def avatar_rotations(hand: BridgedHand, side: Side) -> FloatArray:
    """Return N_j of each joint of a hand in Unity's axes as quaternions (26, 4), x y z w."""
    rotations: FloatArray = (hand.orientations[:, None, :] @ _UNREST[side])[:, 0]
    return rotations


@cache
def _tables(sides: tuple[Side, ...]) -> tuple[NDArray[np.intp], NDArray[np.intp], FloatArray, FloatArray]:
    """Return rows, parents' rows, matrices and axes for the concatenated joints of several hands."""
    starts = [len(JOINTS) * number for number in range(len(sides))]
    return (
        np.concatenate([_ROWS + start for start in starts]),
        np.concatenate([_PARENTS + start for start in starts]),
        np.concatenate([_UNREST[side] for side in sides]),
        np.concatenate([_BONE_AXIS[side] for side in sides]),
    )


def finger_bones(hands: Mapping[Side, BridgedHand]) -> FloatArray:
    """Return the finger bones of hands in their parents' axes, in the order of `FINGER_BONES`.

    A fading hand approaches the open hand of the T-pose. Both hands are computed together: with arrays this small, the
    number of numpy calls determines the time.

    Args:
        hands: one or both, in Unity's axes; each bone lies along its joint's z.

    Returns:
        (hands, 15, 7): positions, metres, and quaternions, x y z w.
    """
    rows, parents, unrest, axis = _tables(tuple(hands))
    q = np.concatenate([hand.orientations for hand in hands.values()])
    p = np.concatenate([hand.positions for hand in hands.values()])
    N = (q[:, None, :] @ unrest)[:, 0]
    bones = np.empty((len(hands), 15, 7))
    offsets = p[rows] - p[parents]
    bones[..., :3] = (np.sqrt((offsets * offsets).sum(axis=1))[:, None] * axis).reshape(-1, 15, 3)
    bones[..., 3:] = relative(N[parents], N[rows]).reshape(-1, 15, 4)
    for number, hand in enumerate(hands.values()):
        R_hand = rotation_from_quaternion(N[number * len(JOINTS) + WRIST])
        bones[number, ::3, :3] = offsets[15 * number : 15 * number + 15 : 3] @ R_hand
        if hand.weight < 1.0:
            bones[number, :, 3:] = faded(bones[number, :, 3:], hand.weight)
    return bones
