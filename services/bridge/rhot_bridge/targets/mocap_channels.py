"""The channels of a MoCap stream.

By the meta-data specification of MoCap streams (sccn/xdf wiki), float32: for each joint PositionX, Y, Z (metres) and
OrientationA, B, C, D (quaternion w, x, y, z), then one Confidence: 1 measured, 0 predicted. The channels of a stream
never change: unknown joints of a body are NaN.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from rhot.anatomy.skeleton import BODY_PARENTS, JOINTS
from rhot_bridge.scene import Body, Hand, Tracked

_POSITION: Final = ("PositionX", "PositionY", "PositionZ")
_ORIENTATION: Final = ("OrientationA", "OrientationB", "OrientationC", "OrientationD")


@dataclass(frozen=True, slots=True)
class Channel:
    """One channel of a stream; fields as in the MoCap specification."""

    label: str
    marker: str
    object: str
    type: str
    unit: str


def channels_of(name: str, joints: Sequence[str]) -> list[Channel]:
    """Return the channels of a stream: position and orientation of each joint, then the confidence.

    Args:
        name: of the stream, such as `hand_right`.
        joints: names of its joints; for a rigid body, its own name.
    """
    channels = []
    for joint in joints:
        for kinds, unit in ((_POSITION, "meters"), (_ORIENTATION, "quaternion")):
            channels += [Channel(f"{joint}_{kind}", joint, name, kind, unit) for kind in kinds]
    return [*channels, Channel("Confidence", "", name, "Confidence", "normalized")]


def sample_of(tracked: Tracked) -> NDArray[np.float32]:
    """Return the values of a sample, float32, in the order of its channels."""
    wxyz = tracked.orientations[:, [3, 0, 1, 2]]
    joints = np.concatenate([tracked.positions, wxyz], axis=1)
    if isinstance(tracked, Body):
        rows = dict(zip(tracked.names, joints, strict=True))
        unknown = np.full(joints.shape[1], np.nan)
        joints = np.array([rows.get(name, unknown) for name in BODY_PARENTS])
    confidence = 1.0 if tracked.state == "measured" else 0.0
    return np.append(joints.ravel(), confidence).astype(np.float32)


def joints_of(name: str, tracked: Tracked) -> tuple[str, ...]:
    """Return the names of all joints that a sample may have; for a rigid body, its own name."""
    if isinstance(tracked, Hand):
        return JOINTS
    return tuple(BODY_PARENTS) if isinstance(tracked, Body) else (name,)
