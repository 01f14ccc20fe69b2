"""Tracked objects and the headset."""

from __future__ import annotations

import math
from typing import Annotated, Final, Literal

from pydantic import Field, field_validator

from rhot.messages.base import Label, Message, Name, Position, Quaternion, State, WireModel, unit_quaternion

Size = Annotated[float, Field(gt=0.0, le=10.0)]
"""Length of an edge, radius or height, metres."""


class BoxShape(WireModel):
    """A cuboid.

    Attributes:
        kind: type of the shape.
        size: edges along the object's x, y, z, metres.
    """

    kind: Literal["box"] = "box"
    size: tuple[Size, Size, Size]


class CylinderShape(WireModel):
    """A cylinder about the object's z axis.

    Attributes:
        kind: type of the shape.
        radius: metres.
        height: from end to end, metres.
    """

    kind: Literal["cylinder"] = "cylinder"
    radius: Size
    height: Size


class SphereShape(WireModel):
    """A sphere.

    Attributes:
        kind: type of the shape.
        radius: metres.
    """

    kind: Literal["sphere"] = "sphere"
    radius: Size


MOST_PLANES: Final = 64
"""Planes of a mesh: 2.3 kB per message. With 32, the median error of a sphere of 40 mm is 1.5 instead of 0.8 mm."""
_NORM_TOLERANCE: Final = 1e-3
_FAR_M: Final = 20.0

Plane = tuple[float, float, float, float]
"""Outward unit normal, and the plane's distance from the middle along it, metres."""


class MeshShape(WireModel):
    """A mesh from a file of the rig folder; fingers touch the planes of its convex hull.

    Attributes:
        kind: type of the shape.
        file: name of the file with its surface, glTF; a reader without this file draws the planes.
        size: edges of its bounding box along the object's x, y, z, metres; the object's frame has the file's axes (y
            up) and its origin in the middle of that box.
        planes: of its convex hull: outward unit normal x, y, z and distance from the middle, metres.
    """

    kind: Literal["mesh"] = "mesh"
    file: Label
    size: tuple[Size, Size, Size]
    planes: Annotated[tuple[Plane, ...], Field(min_length=4, max_length=MOST_PLANES)]

    @field_validator("planes")
    @classmethod
    def _unit(cls, planes: tuple[Plane, ...]) -> tuple[Plane, ...]:
        for x, y, z, distance in planes:
            if abs(math.hypot(x, y, z) - 1.0) > _NORM_TOLERANCE or abs(distance) > _FAR_M:
                raise ValueError(
                    f"plane ({x:.4g}, {y:.4g}, {z:.4g}, {distance:.4g}): its normal must have length 1, and it must "
                    f"lie within {_FAR_M:g} m"
                )
        return planes


FacedShape = BoxShape | CylinderShape | SphereShape
"""Shapes with named faces."""
ObjectShape = Annotated[BoxShape | CylinderShape | SphereShape | MeshShape, Field(discriminator="kind")]


class ObjectPose(Message):
    """Pose of a tracked object.

    Attributes:
        frame: frame of the pose, `rig`.
        position: metres.
        orientation: unit quaternion x, y, z, w.
        state: `measured`, or `predicted` shortly after tracking was lost.
        shape: shape of the object, if known; the pose is that of its middle.
    """

    frame: Name
    position: Position
    orientation: Quaternion
    state: State
    shape: ObjectShape | None = None

    _norm = field_validator("orientation")(unit_quaternion)


class HeadPose(ObjectPose):
    """Pose of the headset."""
