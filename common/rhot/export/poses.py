"""Hand poses as arrays over time, for what needs a whole motion at once."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from rhot.anatomy.skeleton import JOINTS
from rhot.errors import ConfigError
from rhot.geometry.rotations import rotation_from_quaternion
from rhot.messages import HandPose, Message, Side

FloatArray = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class HandMotion:
    """One hand over time.

    Attributes:
        side: whose hand.
        t_ns: (N,) int64, increasing.
        positions: (N, 26, 3) metres, rig frame, order of `rhot.anatomy.skeleton.JOINTS`.
        rotations: (N, 26, 3, 3) joint axes as columns, rig frame.
        incomplete: poses left out because a joint is missing.
    """

    side: Side
    t_ns: NDArray[np.int64]
    positions: FloatArray
    rotations: FloatArray
    incomplete: int


def hand_motion(messages: Iterable[tuple[str, Message]], side: Side | None) -> HandMotion:
    """Collect the complete poses of one hand, by time; of several at one moment the last counts.

    Args:
        messages: of a recording.
        side: whose hand; None = the only one there is.

    Raises:
        ConfigError: no such hand, or both hands and no choice.
    """
    found: dict[Side, dict[int, FloatArray]] = {}
    incomplete = 0
    for _, message in messages:
        if not isinstance(message, HandPose) or side not in (None, message.side):
            continue
        if not all(name in message.joints for name in JOINTS):
            incomplete += 1
            continue
        joints = [message.joints[name] for name in JOINTS]
        pose = np.array([(*joint.position, *joint.orientation) for joint in joints])
        found.setdefault(message.side, {})[message.t_ns] = pose
    if not found:
        which = "hand" if side is None else f"{side} hand"
        raise ConfigError(f"the recording holds no complete pose of a {which} ({incomplete} lack joints)")
    if len(found) > 1:
        raise ConfigError("the recording holds both hands; choose one with --hand left or --hand right")
    ((only, poses),) = found.items()
    t_ns = np.array(sorted(poses), dtype=np.int64)
    stacked = np.stack([poses[moment] for moment in t_ns.tolist()])
    return HandMotion(only, t_ns, stacked[..., :3], rotation_from_quaternion(stacked[..., 3:]), incomplete)
