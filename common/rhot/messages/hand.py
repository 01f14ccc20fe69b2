"""A hand."""

from __future__ import annotations

from typing import Annotated

from pydantic import Field

from rhot.messages.base import Message, Name, Pose, Side, State, WireModel


class Joint(Pose):
    """One joint of the hand.

    Attributes:
        orientation: unit quaternion x, y, z, w; OpenXR axes, +Z from tip to wrist, +Y out of the back of the hand.
        radius: distance from the joint to the skin, metres.
    """

    radius: Annotated[float, Field(ge=0.0, le=1.0)]


class FingerAngles(WireModel):
    """Joint angles of one finger, radians; flexion is positive towards the palm.

    Attributes:
        mcp_flexion, mcp_abduction: metacarpophalangeal joint (knuckle); abduction is positive towards the thumb.
        pip_flexion, dip_flexion: proximal and distal interphalangeal joints.
    """

    mcp_flexion: float
    mcp_abduction: float
    pip_flexion: float
    dip_flexion: float


class HandPose(Message):
    """One hand, from ik.

    Attributes:
        side: left or right hand.
        frame: frame of all positions and orientations.
        joints: the 26 OpenXR joints by name.
        angles: joint angles per finger; for the thumb, MCP is the carpometacarpal joint, PIP the metacarpophalangeal
            and DIP the interphalangeal joint.
        residual: distance between each finger's measured and modelled marker, metres; absent when not measured.
        fingers: state of each finger.
        state: `measured` when the palm and at least one finger are measured.
    """

    side: Side
    frame: Name
    joints: Annotated[dict[Name, Joint], Field(max_length=64)]
    angles: Annotated[dict[Name, FingerAngles], Field(max_length=8)]
    residual: Annotated[dict[Name, Annotated[float, Field(ge=0.0, le=1e3)]], Field(max_length=8)]
    fingers: Annotated[dict[Name, State], Field(max_length=8)] = {}
    state: State
