"""The channels of a MoCap stream: which number of a sample is what.

After the meta-data specification of MoCap streams (sccn/xdf wiki), float32: for each joint PositionX, Y, Z (metres) and
OrientationA, B, C, D (quaternion w, x, y, z), then one Confidence: 1 measured, 0 predicted. A stream has the same
channels from its beginning to its end: joints of a body that are not known at a moment are NaN.
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
    """One number of a stream, in the words of the MoCap specification."""

    label: str
    marker: str
    object: str
    type: str
    unit: str


def channels_of(name: str, joints: Sequence[str]) -> list[Channel]:
    """Return the channels of a thing: of each joint position and orientation, then the confidence.

    Args:
        name: of the thing, such as `hand_right`.
        joints: its joints; one, of the thing's own name, where it is rigid.
    """
    channels = []
    for joint in joints:
        for kinds, unit in ((_POSITION, "meters"), (_ORIENTATION, "quaternion")):
            channels += [Channel(f"{joint}_{kind}", joint, name, kind, unit) for kind in kinds]
    return [*channels, Channel("Confidence", "", name, "Confidence", "normalized")]


def sample_of(tracked: Tracked) -> NDArray[np.float32]:
    """Return the numbers of a sample, in the order of its channels."""
    wxyz = tracked.orientations[:, [3, 0, 1, 2]]
    joints = np.concatenate([tracked.positions, wxyz], axis=1)
    if isinstance(tracked, Body):
        rows = dict(zip(tracked.names, joints, strict=True))
        unknown = np.full(joints.shape[1], np.nan)
        joints = np.array([rows.get(name, unknown) for name in BODY_PARENTS])
    confidence = 1.0 if tracked.state == "measured" else 0.0
    return np.append(joints.ravel(), confidence).astype(np.float32)


def joints_of(name: str, tracked: Tracked) -> tuple[str, ...]:
    """Return the names of all joints that a thing may have; its own name where it is rigid."""
    if isinstance(tracked, Hand):
        return JOINTS
    return tuple(BODY_PARENTS) if isinstance(tracked, Body) else (name,)
