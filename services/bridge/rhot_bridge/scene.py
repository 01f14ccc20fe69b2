"""What a bridge sends of one moment: plain arrays, all in one frame."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Literal, Self

import numpy as np

from rhot.anatomy.skeleton import JOINTS
from rhot.arrays import FloatArray
from rhot.errors import WireError
from rhot.messages import BodyPose, FootPose, HandPose, ObjectPose, ObjectShape, Side

Axes = Literal["rig", "stage", "unity"]
"""The frame and handedness of a scene's numbers; see `rhot_bridge.axes`."""
SentState = Literal["measured", "predicted", "kept"]
"""As in the messages; `kept`: nothing has come for a while, the last is repeated or fades."""


@dataclass(frozen=True, slots=True)
class Poses:
    """Poses that belong together: a hand's joints, a body's joints, or one thing.

    Attributes:
        t_ns: when they were true, rig clock.
        state: whether they are measured.
        weight: 1, falling to 0 while they fade.
        positions: (N, 3) metres.
        orientations: (N, 4) unit quaternions, x y z w.
    """

    t_ns: int
    state: SentState
    weight: float
    positions: FloatArray
    orientations: FloatArray

    def moved(self, positions: FloatArray, orientations: FloatArray) -> Self:
        """Return the same poses at positions (N, 3), metres, with orientations (N, 4), x, y, z, w."""
        return type(self)(self.t_ns, self.state, self.weight, positions, orientations)


@dataclass(frozen=True, slots=True)
class Hand(Poses):
    """One hand; rows in the order of `rhot.anatomy.skeleton.JOINTS`, OpenXR's.

    Attributes:
        radii: (26,) metres, flesh around each joint.
    """

    radii: FloatArray

    def moved(self, positions: FloatArray, orientations: FloatArray) -> Hand:
        """Return the same hand at positions (N, 3), metres, with orientations (N, 4), x, y, z, w."""
        return Hand(self.t_ns, self.state, self.weight, positions, orientations, self.radii)


@dataclass(frozen=True, slots=True)
class Thing(Poses):
    """An object, the head or a foot: one row.

    Attributes:
        shape: of an object, where it is known.
    """

    shape: ObjectShape | None = None

    def moved(self, positions: FloatArray, orientations: FloatArray) -> Thing:
        """Return the same thing at positions (N, 3), metres, with orientations (N, 4), x, y, z, w."""
        return Thing(self.t_ns, self.state, self.weight, positions, orientations, self.shape)


@dataclass(frozen=True, slots=True)
class Body(Poses):
    """Hips and legs.

    Attributes:
        names: of the rows; see `rhot.messages.BodyPose`.
    """

    names: tuple[str, ...] = ()

    def moved(self, positions: FloatArray, orientations: FloatArray) -> Body:
        """Return the same body at positions (N, 3), metres, with orientations (N, 4), x, y, z, w."""
        return Body(self.t_ns, self.state, self.weight, positions, orientations, self.names)

    def row(self, name: str) -> int | None:
        """Return the row of a joint, None when it is not known."""
        return self.names.index(name) if name in self.names else None


Tracked = Hand | Thing | Body


@dataclass(frozen=True, slots=True)
class Scene:
    """All that is sent of one moment.

    Attributes:
        axes: of all numbers.
        t_ns: the newest of its parts' times, rig clock.
        hands, feet: by side.
        objects: by id.
        head, body: None when there is none.
    """

    axes: Axes
    t_ns: int = 0
    hands: Mapping[Side, Hand] = field(default_factory=dict)
    objects: Mapping[str, Thing] = field(default_factory=dict)
    head: Thing | None = None
    feet: Mapping[Side, Thing] = field(default_factory=dict)
    body: Body | None = None

    @property
    def empty(self) -> bool:
        """Whether there is nothing to send."""
        return not (self.hands or self.objects or self.head or self.feet or self.body)


def tracked(message: HandPose | ObjectPose | FootPose | BodyPose) -> Tracked:
    """Return a message as arrays.

    Raises:
        WireError: a hand lacks joints.
    """
    if isinstance(message, HandPose):
        missing = [name for name in JOINTS if name not in message.joints]
        if missing:
            raise WireError(f"the {message.side} hand lacks {len(missing)} of 26 joints: {missing[0]}, …")
        joints = [message.joints[name] for name in JOINTS]
        table = np.array([(*joint.position, *joint.orientation, joint.radius) for joint in joints])
        return Hand(message.t_ns, message.state, 1.0, table[:, :3], table[:, 3:7], table[:, 7])
    if isinstance(message, BodyPose):
        rows = np.array([(*joint.position, *joint.orientation) for joint in message.joints.values()]).reshape(-1, 7)
        return Body(message.t_ns, message.state, 1.0, rows[:, :3], rows[:, 3:], tuple(message.joints))
    shape = message.shape if isinstance(message, ObjectPose) else None
    position, orientation = np.array([message.position]), np.array([message.orientation])
    return Thing(message.t_ns, message.state, 1.0, position, orientation, shape)
