"""From OpenXR's joints to a VRM avatar's bones.

Unity's axes. All bones of a VRM avatar are the identity in its T-pose: arms along ∓x, palms down, thumbs halfway
forward. With R_j the axes of an OpenXR joint (z along the bone to its tip, y out of its back) and I_j the same in the
T-pose, a bone is rotated from the T-pose by

    N_j = R_j · I_j⁻¹            and what is sent is N_parent⁻¹ · N_j

I_j by its z (along the bone) and y (out of the back): left fingers −x and +y, right fingers +x and +y; left thumb
(−1, 0, 1)/√2 and (1, 0, 1)/√2, right thumb mirrored in x. The bones ThumbProximal, Intermediate and Distal are
OpenXR's thumb metacarpal, proximal and distal; the other metacarpals are fixed in VRM: fingers hang on the hand.
Positions are the hand's own, p_sent = N_parent⁻¹ · (p_j − p_parent): zeros would crush the fingers of some programs.
"""

from __future__ import annotations

from typing import Final

import numpy as np
from numpy.typing import NDArray

from rhot.anatomy.hand import WRIST
from rhot.anatomy.skeleton import FINGERS, JOINTS
from rhot.geometry.rotations import quaternion_from_rotation, rotation_from_quaternion
from rhot.messages import Side
from rhot_bridge.retarget.quaternions import conjugate, faded, relative, right_product
from rhot_bridge.scene import Hand

FloatArray = NDArray[np.float64]

_SEGMENTS: Final = ("Proximal", "Intermediate", "Distal")
_DIAGONAL: Final = np.sqrt(0.5)


def _finger_joints(finger: str) -> tuple[str, str, str]:
    if finger == "thumb":
        return "thumb_metacarpal", "thumb_proximal", "thumb_distal"
    return f"{finger}_proximal", f"{finger}_intermediate", f"{finger}_distal"


FINGER_BONES: Final = tuple(f"{finger.capitalize()}{segment}" for finger in FINGERS for segment in _SEGMENTS)
"""The 15 bones of a hand, without the side before each name."""
_ROWS: Final = np.array([JOINTS.index(joint) for finger in FINGERS for joint in _finger_joints(finger)])
_PARENTS: Final = np.array([WRIST if place % 3 == 0 else _ROWS[place - 1] for place in range(15)])


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
"""(26, 3, 3) I_j of each joint."""


_UNREST: Final = {side: right_product(conjugate(quaternion_from_rotation(rest))) for side, rest in REST.items()}
"""(26, 4, 4) matrices: q_j @ _UNREST_j is the quaternion of N_j."""
_BONE_AXIS: Final = {side: rest[_PARENTS] @ np.array([0.0, 0.0, 1.0]) for side, rest in REST.items()}
"""(15, 3) where each bone's parent points in the T-pose: there its own joint lies."""


def avatar_rotations(hand: Hand, side: Side) -> FloatArray:
    """Return N_j of each joint of a hand in Unity's axes as quaternions (26, 4), x y z w."""
    rotations: FloatArray = (hand.orientations[:, None, :] @ _UNREST[side])[:, 0]
    return rotations


def finger_bones(hand: Hand, side: Side) -> FloatArray:
    """Return the finger bones of a hand in their parents' axes, in the order of `FINGER_BONES`.

    What fades goes to the open hand of the T-pose.

    Args:
        hand: in Unity's axes; each bone lies along its joint's z.
        side: whose.

    Returns:
        (15, 7): positions, metres, and quaternions, x y z w.
    """
    N = avatar_rotations(hand, side)
    bones = np.empty((15, 7))
    offsets = hand.positions[_ROWS] - hand.positions[_PARENTS]
    bones[:, :3] = np.sqrt((offsets * offsets).sum(axis=1))[:, None] * _BONE_AXIS[side]
    bones[::3, :3] = offsets[::3] @ rotation_from_quaternion(N[WRIST])
    bones[:, 3:] = faded(relative(N[_PARENTS], N[_ROWS]), hand.weight)
    return bones
