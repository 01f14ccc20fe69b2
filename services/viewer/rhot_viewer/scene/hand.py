"""A hand as balls at its joints and rods for its bones, as thick as its flesh."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from itertools import pairwise
from typing import Final

import numpy as np
from numpy.typing import NDArray

from rhot.anatomy.skeleton import CHAINS, FINGERS, JOINTS, PARENTS
from rhot.arrays import FloatArray
from rhot.messages import HandPose, Side, State, TruePose
from rhot_viewer.scene.instances import Instances, Rgb, balls, rods

BONE_COLOR: Final[dict[str, Rgb]] = {"right": (226, 184, 150), "left": (196, 176, 208)}
JOINT_COLOR: Final[dict[str, Rgb]] = {"right": (186, 128, 92), "left": (140, 112, 160)}
PREDICTED_BONE: Final[Rgb] = (150, 190, 235)
PREDICTED_JOINT: Final[Rgb] = (88, 140, 205)
GHOST: Final[Rgb] = (120, 205, 140)
GHOST_SWELL: Final = 1.18
"""The ghost is this much thicker: around a hand that is tracked well it shows as a rim of even width."""

_BONE_SHARE: Final = 0.86
"""A bone is a little thinner than its joints, so that these can be seen."""
_FINGER_OF: Final = {
    joint: finger for finger, chain in CHAINS.items() for joint in chain if not joint.endswith("_metacarpal")
}
"""The joints that move with a finger; all others belong to the palm."""
_KNUCKLES: Final = tuple(f"{finger}_proximal" for finger in FINGERS[1:])
_LINKS: Final[tuple[tuple[str, str], ...]] = (
    *((parent, joint) for joint, parent in PARENTS.items() if parent is not None and joint != "palm"),
    *pairwise(_KNUCKLES),
)
"""Every bone from its nearer to its farther joint; then the flesh between neighbouring knuckles."""
_ROW: Final = {joint: row for row, joint in enumerate(JOINTS)}
_BALLS: Final = np.array([_ROW[joint] for joint in JOINTS if joint != "palm"])
_STARTS: Final = np.array([_ROW[start] for start, _ in _LINKS])
_ENDS: Final = np.array([_ROW[end] for _, end in _LINKS])


@dataclass(frozen=True, slots=True)
class HandShape:
    """A hand to be drawn.

    Attributes:
        joints: balls.
        bones: rods.
    """

    joints: Instances
    bones: Instances


def hand_shape(pose: HandPose) -> HandShape | None:
    """Return a tracked hand, what is only predicted in another colour; None when one of the 26 joints is missing."""
    if any(name not in pose.joints for name in JOINTS):
        return None
    joints = [pose.joints[name] for name in JOINTS]
    positions = np.array([joint.position for joint in joints])
    radii = np.array([joint.radius for joint in joints])
    predicted = _predicted_rows(pose.fingers, pose.state)
    ball_colors = np.where(predicted[:, None], PREDICTED_JOINT, JOINT_COLOR[pose.side])
    rod_colors = np.where(predicted[_ENDS][:, None], PREDICTED_BONE, BONE_COLOR[pose.side])
    return _shape(positions, radii, ball_colors[_BALLS], rod_colors)


def ghost_shape(joints: Mapping[str, TruePose], radii: FloatArray) -> HandShape | None:
    """Return a true hand, swollen a little; None when one of the 26 joints is missing.

    Args:
        joints: pose by joint name, rig frame.
        radii: (26,) metres, of the flesh around each joint.
    """
    if any(name not in joints for name in JOINTS):
        return None
    positions = np.array([joints[name].position for name in JOINTS])
    return _shape(
        positions, GHOST_SWELL * radii, np.tile(GHOST, (len(_BALLS), 1)), np.tile(GHOST, (len(_ENDS), 1)), 1.0
    )


def fingertips(side: Side, pose: HandPose) -> dict[str, tuple[float, float, float]]:
    """Return the positions of a hand's tip joints by `<side> <finger>`, metres, rig frame; a missing one is absent."""
    return {
        f"{side} {finger}": pose.joints[f"{finger}_tip"].position
        for finger in FINGERS
        if f"{finger}_tip" in pose.joints
    }


def _predicted_rows(fingers: Mapping[str, State], state: State) -> NDArray[np.bool_]:
    """Tell per joint (26,) whether it is predicted; the palm follows the whole hand."""
    return np.array([fingers.get(_FINGER_OF.get(joint, ""), state) == "predicted" for joint in JOINTS])


def _shape(
    positions: FloatArray,
    radii: FloatArray,
    ball_colors: NDArray[np.int_],
    rod_colors: NDArray[np.int_],
    share: float = _BONE_SHARE,
) -> HandShape:
    # The wrist's ball alone is thinner than the flesh: as thick, it would hide the hand from whoever sits behind
    # it.
    ball_radii = radii[_BALLS] * np.where(_ROW["wrist"] == _BALLS, 0.75, 1.0)
    rod_radii = share * 0.5 * (radii[_STARTS] + radii[_ENDS])
    return HandShape(
        balls(positions[_BALLS], ball_radii, ball_colors),
        rods(positions[_STARTS], positions[_ENDS], rod_radii, rod_colors),
    )
