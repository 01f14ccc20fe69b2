"""The poses that a bridge sends at one moment, as plain arrays in one frame."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Final, Literal, Self

import numpy as np

from rhot.anatomy.skeleton import JOINTS
from rhot.arrays import BoolArray, FloatArray
from rhot.errors import WireError
from rhot.messages import BodyPose, FootPose, HandPose, ObjectPose, ObjectShape, Side

Axes = Literal["rig", "stage", "unity"]
"""Frame and handedness of a scene's poses; see `rhot_bridge.axes`."""
SentState = Literal["measured", "predicted", "kept"]
"""As in the messages; `kept`: no sample has come for a while, and the last one is repeated or fades."""

_PARTS: Final = tuple(name.partition("_")[0] for name in JOINTS)
"""Palm, wrist or finger that each joint belongs to."""


@dataclass(frozen=True, slots=True)
class Poses:
    """The poses of one message: a hand's joints, a body's joints, or one rigid body.

    Attributes:
        t_ns: time of the sample, rig clock.
        state: measured, predicted or kept.
        weight: 1, falling to 0 while the poses fade.
        positions: (N, 3) metres.
        orientations: (N, 4) unit quaternions, x y z w.
    """

    t_ns: int
    state: SentState
    weight: float
    positions: FloatArray
    orientations: FloatArray

    def moved(self, positions: FloatArray, orientations: FloatArray) -> Self:
        """Return a copy with other positions (N, 3), metres, and orientations (N, 4), x y z w."""
        return replace(self, positions=positions, orientations=orientations)


@dataclass(frozen=True, slots=True)
class BridgedHand(Poses):
    """One hand; rows in the order of `rhot.anatomy.skeleton.JOINTS`, OpenXR's.

    Attributes:
        radii: (26,) metres, radius of the flesh around each joint.
        measured: (26,) whether a camera saw the joint's finger.
    """

    radii: FloatArray
    measured: BoolArray = field(default_factory=lambda: np.ones(len(JOINTS), dtype=np.bool_))


@dataclass(frozen=True, slots=True)
class Thing(Poses):
    """An object, the head or a foot: one row.

    Attributes:
        shape: of an object, if known.
    """

    shape: ObjectShape | None = None


@dataclass(frozen=True, slots=True)
class Body(Poses):
    """The joints of a body.

    Attributes:
        names: joint of each row; see `rhot.messages.BodyPose`.
    """

    names: tuple[str, ...] = ()

    def row(self, name: str) -> int | None:
        """Return the row of a joint, None if the body lacks it."""
        return self.names.index(name) if name in self.names else None


Tracked = BridgedHand | Thing | Body


@dataclass(frozen=True, slots=True)
class Scene:
    """All poses that are sent at one moment.

    Attributes:
        axes: of all poses.
        t_ns: newest time of the poses, rig clock.
        hands, feet: by side.
        objects: by id.
        head, body: None if absent.
    """

    axes: Axes
    t_ns: int = 0
    hands: Mapping[Side, BridgedHand] = field(default_factory=dict)
    objects: Mapping[str, Thing] = field(default_factory=dict)
    head: Thing | None = None
    feet: Mapping[Side, Thing] = field(default_factory=dict)
    body: Body | None = None

    @property
    def empty(self) -> bool:
        """Whether the scene holds no poses."""
        return not (self.hands or self.objects or self.head or self.feet or self.body)


def tracked(message: HandPose | ObjectPose | FootPose | BodyPose) -> Tracked:
    """Return the poses of a message as arrays, rig axes.

    Raises:
        WireError: a hand lacks joints.
    """
    if isinstance(message, HandPose):
        missing = [name for name in JOINTS if name not in message.joints]
        if missing:
            raise WireError(f"the {message.side} hand lacks {len(missing)} of 26 joints: {missing[0]}, …")
        joints = [message.joints[name] for name in JOINTS]
        table = np.array([(*joint.position, *joint.orientation, joint.radius) for joint in joints])
        measured = np.array([message.fingers.get(part, message.state) == "measured" for part in _PARTS])
        return BridgedHand(message.t_ns, message.state, 1.0, table[:, :3], table[:, 3:7], table[:, 7], measured)
    if isinstance(message, BodyPose):
        rows = np.array([(*joint.position, *joint.orientation) for joint in message.joints.values()]).reshape(-1, 7)
        return Body(message.t_ns, message.state, 1.0, rows[:, :3], rows[:, 3:], tuple(message.joints))
    shape = message.shape if isinstance(message, ObjectPose) else None
    position, orientation = np.array([message.position]), np.array([message.orientation])
    return Thing(message.t_ns, message.state, 1.0, position, orientation, shape)
