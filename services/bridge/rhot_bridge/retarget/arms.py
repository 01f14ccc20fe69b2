"""Hips, spine, arms and legs of an avatar.

Unity's axes; N as in `rhot_bridge.retarget.vrm`. Without `rhot/body`, neck, shoulders and hips are placed below the
head, and the elbow follows from two bones of known length, on the side that points down, a little outwards and back.
Half of the hand's rotation about the forearm is applied to the forearm, as in anatomy. Lengths are shares of the body's
height, from the figure that `rhot.anatomy.body_proportions` names.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np

from rhot.anatomy.body_proportions import (
    FOREARM,
    HIPS_BELOW_NECK,
    NECK_BEHIND_EYES,
    NECK_BELOW_EYES,
    SHOULDER_BELOW_NECK,
    SHOULDER_OUTWARDS,
    UPPER_ARM,
)
from rhot.anatomy.hand import WRIST
from rhot.arrays import FloatArray
from rhot.geometry.rotations import (
    quaternion_from_rotation,
    rotation_from_quaternion,
    rotation_x,
    rotation_y,
)
from rhot.messages import Side
from rhot_bridge.retarget.vrm import avatar_rotations
from rhot_bridge.scene import Body, Scene

_ELBOW: Final = np.array([0.4, -1.0, -0.3])
"""Preferred direction of the elbow: outwards, up, forwards of the trunk. Chosen to look natural, not measured."""
_REACH: Final = 0.999
"""Largest share of an arm's length between shoulder and wrist: in a straight arm the elbow's side is undefined."""
_SPINE: Final = (("Spine", "spine_lower"), ("Chest", "chest"), ("Neck", "neck"), ("Head", "head"))
_LEGS: Final = (("UpperLeg", "hip"), ("LowerLeg", "knee"), ("Foot", "ankle"))


@dataclass(frozen=True, slots=True)
class Bone:
    """One bone of an avatar in its parent's axes.

    Attributes:
        name: Unity's HumanBodyBones name.
        position: (3,) metres, parent's axes.
        rotation: (3, 3) bone to parent.
    """

    name: str
    position: FloatArray
    rotation: FloatArray


def body_bones(scene: Scene, height_m: float) -> list[Bone]:
    """Return hips, head, arms and legs as far as they are known; none without a head.

    Args:
        scene: in Unity's axes.
        height_m: height of the person.
    """
    if scene.head is None:
        return []
    N_head = rotation_from_quaternion(scene.head.orientations[0])
    neck_in_head = height_m * np.array([0.0, -NECK_BELOW_EYES, -NECK_BEHIND_EYES])
    neck = scene.head.positions[0] + N_head @ neck_in_head
    body, row = scene.body, None if scene.body is None else scene.body.row("hips")
    if body is not None and row is not None:
        hips, N_hips = body.positions[row], rotation_from_quaternion(body.orientations[row])
    else:
        forward = N_head[:, 2]
        N_hips = rotation_y(float(np.arctan2(forward[0], forward[2])))
        hips = neck - np.array([0.0, HIPS_BELOW_NECK * height_m, 0.0])
    bones = [Bone("Hips", hips, N_hips)]
    if body is not None and body.row("chest") is not None:
        bones += _chain(body, _SPINE, hips, N_hips)
        chest = body.row("chest")
        origin, N_chest = body.positions[chest], rotation_from_quaternion(body.orientations[chest])
    else:
        bones.append(Bone("Head", N_hips.T @ (neck - hips), N_hips.T @ N_head))
        origin, N_chest = neck, N_hips
    for side in scene.hands:
        bones += _arm(scene, side, neck, origin, N_chest, height_m)
    if body is not None:
        for side in ("left", "right"):
            legs = tuple((f"{side.capitalize()}{bone}", f"{side}_{joint}") for bone, joint in _LEGS)
            bones += _chain(body, legs, hips, N_hips)
    return bones


def _arm(
    scene: Scene, side: Side, neck: FloatArray, origin: FloatArray, N_chest: FloatArray, height_m: float
) -> list[Bone]:
    """Return the bones of one arm; `origin` (3,) is the position of its parent bone, `N_chest` (3, 3) its axes."""
    out = 1.0 if side == "right" else -1.0
    hand = scene.hands[side]
    outwards = np.array([out * SHOULDER_OUTWARDS, -SHOULDER_BELOW_NECK, 0.0])
    shoulder = neck + N_chest @ (height_m * outwards)
    upper_m, lower_m = UPPER_ARM * height_m, FOREARM * height_m
    pole = N_chest @ (_ELBOW * np.array([out, 1.0, 1.0]))
    body = scene.body
    rows = () if body is None else tuple(body.row(f"{side}_{joint}") for joint in ("shoulder", "elbow", "wrist"))
    if body is not None and rows and None not in rows:
        shoulder, joint, end = (body.positions[row] for row in rows if row is not None)
        upper_m, lower_m = float(np.linalg.norm(joint - shoulder)), float(np.linalg.norm(end - joint))
        pole = joint - 0.5 * (shoulder + end)
    elbow, wrist, hinge = two_bones(shoulder, hand.positions[WRIST], upper_m, lower_m, pole)
    name = side.capitalize()
    N_upper = _axes(out * (elbow - shoulder), -out * hinge)
    N_lower = _axes(out * (wrist - elbow), -out * hinge)
    N_hand = rotation_from_quaternion(avatar_rotations(hand, side)[WRIST])
    x, _, _, w = quaternion_from_rotation(N_lower.T @ N_hand).tolist()
    # Twist about the forearm (swing and twist): 2·atan(x / w), of which the forearm takes half.
    N_lower = N_lower @ rotation_x(float(np.arctan2(x, w) if w >= 0.0 else np.arctan2(-x, -w)))
    length = np.array([out, 0.0, 0.0])
    return [
        Bone(f"{name}UpperArm", N_chest.T @ (shoulder - origin), N_chest.T @ N_upper),
        Bone(f"{name}LowerArm", length * upper_m, N_upper.T @ N_lower),
        Bone(f"{name}Hand", length * lower_m, N_lower.T @ N_hand),
    ]


def two_bones(
    start: FloatArray, end: FloatArray, first_m: float, second_m: float, pole: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return the joint between two bones of known length (two-bone inverse kinematics).

    Args:
        start, end: (3,) metres; an end out of reach is moved nearer along the same line.
        first_m, second_m: lengths of the bones.
        pole: (3,) direction of the side on which the joint lies.

    Returns:
        The joint (3,), the reached end (3,), and the hinge (3,): the unit vector along first bone × second bone.
    """
    way = end - start
    far = float(np.linalg.norm(way))
    u = way / far if far > 1e-6 else np.array([0.0, -1.0, 0.0])
    d = float(np.clip(far, abs(first_m - second_m) + 1e-3, _REACH * (first_m + second_m)))
    side = pole - (pole @ u) * u
    size = float(np.linalg.norm(side))
    if size < 1e-6:
        side, size = np.cross(u, np.eye(3)[int(np.argmin(np.abs(u)))]), 1.0
    side = side / np.linalg.norm(side)
    along = (first_m**2 - second_m**2 + d * d) / (2.0 * d)
    aside = float(np.sqrt(max(first_m**2 - along**2, 0.0)))
    return start + along * u + aside * side, start + d * u, np.cross(side, u)


def _axes(x: FloatArray, y: FloatArray) -> FloatArray:
    """Return N (3, 3) with x along a vector (3,) and y, a unit vector (3,) perpendicular to it."""
    unit = x / np.linalg.norm(x)
    return np.stack([unit, y, np.cross(unit, y)], axis=1)


def _chain(body: Body, joints: Sequence[tuple[str, str]], start: FloatArray, N_start: FloatArray) -> list[Bone]:
    """Return the bones of a chain of joints up to the first one that the body lacks, in their parents' axes."""
    bones: list[Bone] = []
    before, N_before = start, N_start
    for bone, joint in joints:
        row = body.row(joint)
        if row is None:
            break
        position, N = body.positions[row], rotation_from_quaternion(body.orientations[row])
        bones.append(Bone(bone, N_before.T @ (position - before), N_before.T @ N))
        before, N_before = position, N
    return bones
