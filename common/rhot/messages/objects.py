"""Tracked objects and the headset."""

from __future__ import annotations

from pydantic import field_validator

from rhot.messages.base import Message, Name, Position, Quaternion, State, unit_quaternion


class ObjectPose(Message):
    """Pose of a tracked object.

    Attributes:
        frame: frame of the pose, `rig`.
        position: metres.
        orientation: unit quaternion x, y, z, w.
        state: measured, or predicted where tracking was lost a moment ago.
    """

    frame: Name
    position: Position
    orientation: Quaternion
    state: State

    _norm = field_validator("orientation")(unit_quaternion)


class HeadPose(ObjectPose):
    """Pose of the headset."""
