"""Tracked objects and the headset."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field, field_validator

from rhot.messages.base import Message, Name, Position, Quaternion, State, WireModel, unit_quaternion

Size = Annotated[float, Field(gt=0.0, le=10.0)]
"""An edge, a radius or a height, metres."""


class BoxShape(WireModel):
    """A cuboid.

    Attributes:
        kind: which shape.
        size: edges along the object's x, y, z, metres.
    """

    kind: Literal["box"] = "box"
    size: tuple[Size, Size, Size]


class CylinderShape(WireModel):
    """A round body with flat ends; its axis is the object's z.

    Attributes:
        kind: which shape.
        radius: metres.
        height: from end to end, metres.
    """

    kind: Literal["cylinder"] = "cylinder"
    radius: Size
    height: Size


class SphereShape(WireModel):
    """A ball.

    Attributes:
        kind: which shape.
        radius: metres.
    """

    kind: Literal["sphere"] = "sphere"
    radius: Size


ObjectShape = Annotated[BoxShape | CylinderShape | SphereShape, Field(discriminator="kind")]


class ObjectPose(Message):
    """Pose of a tracked object.

    Attributes:
        frame: frame of the pose, `rig`.
        position: metres.
        orientation: unit quaternion x, y, z, w.
        state: measured, or predicted where tracking was lost a moment ago.
        shape: what fingers meet, where it is known; the pose is that of its middle.
    """

    frame: Name
    position: Position
    orientation: Quaternion
    state: State
    shape: ObjectShape | None = None

    _norm = field_validator("orientation")(unit_quaternion)


class HeadPose(ObjectPose):
    """Pose of the headset."""
