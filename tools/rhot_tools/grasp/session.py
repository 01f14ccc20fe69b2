"""One hand and one object over time, at the moments of the hand's poses."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np

from rhot.anatomy.skeleton import FINGERS, JOINTS
from rhot.arrays import BoolArray, FloatArray
from rhot.errors import ConfigError
from rhot.geometry.rotations import rigid
from rhot.messages import HandPose, Message, ObjectPose
from rhot.messages.tracked import ObjectShape
from rhot_tools.export.poses import ExportedMotion, motions
from rhot_tools.export.skeleton_motion import rotations_between

TIPS = tuple(JOINTS.index(f"{finger}_tip") for finger in FINGERS)
"""Of the five fingers, in the order of `FINGERS`, thumb first."""
PALM = JOINTS.index("palm")


@dataclass(frozen=True, slots=True)
class GraspSession:
    """N poses of a hand, with the object where it was at the same moments.

    Attributes:
        t_ns: (N,) int64, increasing, rig clock.
        joints: (N, 26, 3) metres, rig frame, in OpenXR's order.
        palm: (N, 3, 3) axes of the palm joint as columns.
        radii_m: (26,) of the flesh around each joint.
        measured: (N, 5) whether each finger was.
        objects: (N, 4, 4) T_rig_object of the shape's middle.
        shape: of the object.
    """

    t_ns: np.ndarray[tuple[int], np.dtype[np.int64]]
    joints: FloatArray
    palm: FloatArray
    radii_m: FloatArray
    measured: BoolArray
    objects: FloatArray
    shape: ObjectShape

    @property
    def t_s(self) -> FloatArray:
        """(N,) seconds since the first pose."""
        seconds: FloatArray = 1e-9 * (self.t_ns - self.t_ns[0])
        return seconds


def grasp_session(
    messages: Iterable[tuple[str, Message]],
    hand: str | None = None,
    item: str | None = None,
    shape: ObjectShape | None = None,
) -> GraspSession:
    """Collect a hand and an object from messages.

    Args:
        messages: of a recording or of `rhot process`, rig frame.
        hand: `left` or `right`; None = the only one.
        item: id of the object; None = the only one.
        shape: of the object, in place of what its messages say.

    Raises:
        ConfigError: no such hand or object, a choice is needed, no shape is known, or the two were hardly ever there
            together.
    """
    kept = [(key, message) for key, message in messages if isinstance(message, HandPose | ObjectPose)]
    found = motions(kept)
    hand_motion = _chosen(found, "hand_", hand, "--hand")
    object_motion = _chosen(found, "object_", item, "--object")
    shape = shape or object_motion.shape
    if shape is None:
        raise ConfigError(
            f"{object_motion.name} has no shape, so nobody knows where its surface is; give --shape, or `shape = …` "
            "under [objects.NAME] of rig.toml before the next recording"
        )
    inside = (hand_motion.t_ns >= object_motion.t_ns[0]) & (hand_motion.t_ns <= object_motion.t_ns[-1])
    least_poses = 10
    if int(inside.sum()) < least_poses:
        raise ConfigError(
            f"{hand_motion.name} and {object_motion.name} were there together in {int(inside.sum())} poses only"
        )
    t_ns = hand_motion.t_ns[inside]
    side = hand_motion.name.removeprefix("hand_")
    fingers = {
        message.t_ns: [message.fingers.get(finger, message.state) == "measured" for finger in FINGERS]
        for _, message in kept
        if isinstance(message, HandPose) and message.side == side
    }
    return GraspSession(
        t_ns=t_ns,
        joints=hand_motion.positions[inside],
        palm=hand_motion.rotations[inside, PALM],
        radii_m=hand_motion.radii_m,
        measured=np.array([fingers[moment] for moment in t_ns.tolist()]),
        objects=poses_at(object_motion, t_ns),
        shape=shape,
    )


def _chosen(found: dict[str, ExportedMotion], prefix: str, wanted: str | None, option: str) -> ExportedMotion:
    names = [name for name in found if name.startswith(prefix)]
    if wanted is not None:
        names = [name for name in names if name == prefix + wanted]
    what = prefix.rstrip("_")
    if not names:
        raise ConfigError(f"the recording holds no {what}{'' if wanted is None else f' {wanted}'}")
    if len(names) > 1:
        raise ConfigError(f"the recording holds {', '.join(names)}; choose one with {option}")
    return found[names[0]]


def poses_at(motion: ExportedMotion, t_ns: np.ndarray[tuple[int], np.dtype[np.int64]]) -> FloatArray:
    """Return a rigid thing's poses (N, 4, 4) at times between its own, interpolated."""
    before = np.clip(np.searchsorted(motion.t_ns, t_ns, side="right") - 1, 0, len(motion.t_ns) - 2)
    span = motion.t_ns[before + 1] - motion.t_ns[before]
    share = np.clip((t_ns - motion.t_ns[before]) / span, 0.0, 1.0)
    places = motion.positions[:, 0]
    position = places[before] + share[:, None] * (places[before + 1] - places[before])
    rotation = rotations_between(motion.rotations[before], motion.rotations[before + 1], share)[:, 0]
    return np.stack([rigid(R, p) for R, p in zip(rotation, position, strict=True)])
