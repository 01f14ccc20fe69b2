"""Ground truth of a simulated world."""

from __future__ import annotations

from typing import Annotated

from pydantic import Field

from rhot.messages.base import Message, Name, Pose, Position, Side


class TruePose(Pose):
    """A pose of the simulated world."""


class Truth(Message):
    """Ground truth of the simulated world, rig frame: 60 Hz while there is a subscriber, 10 Hz otherwise.

    Attributes:
        frame: frame of all poses, `rig`.
        points: centre of each marker's painted volume, metres.
        hands: side to OpenXR joint name to pose.
        objects: object id to pose.
        head: pose of the headset.
        feet: side to pose, see `FootPose`.
        body: joint name to pose, see `BodyPose`.
    """

    frame: Name
    points: Annotated[dict[Name, Position], Field(max_length=256)]
    hands: Annotated[dict[Name, dict[Name, TruePose]], Field(max_length=2)]
    objects: Annotated[dict[Name, TruePose], Field(max_length=64)]
    head: TruePose | None = None
    feet: Annotated[dict[Side, TruePose], Field(max_length=2)] = {}
    body: Annotated[dict[Name, TruePose], Field(max_length=32)] = {}
