"""Feet, and the legs that follow from them."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field, field_validator

from rhot.messages.base import Message, Name, Pose, Position, Quaternion, Side, State, WireModel, unit_quaternion


class FootPose(Message):
    """One foot, from the feet service.

    The foot's frame has its origin in the centre of the foot's marker, +X to the foot's right, +Y up out of the instep
    and +Z from the toes to the heel.

    Attributes:
        side: which foot.
        frame: frame of all vectors, `rig`.
        position: metres.
        orientation: unit quaternion x, y, z, w.
        velocity: metres per second.
        sigma: standard deviation of the position, metres (root of the sum of the three variances).
        stage: the best evidence of the last moment: the `marker`, the foot's blob in the `depth` image, the `inertial`
            sensor alone, or nothing (`lost`: the last position is held).
        stationary: the foot stands still.
        state: measured while a marker, the depth image or a stand-still backs the position, else predicted.
    """

    side: Side
    frame: Name
    position: Position
    orientation: Quaternion
    velocity: tuple[float, float, float]
    sigma: Annotated[float, Field(ge=0.0, le=1e3)]
    stage: Literal["marker", "depth", "inertial", "lost"]
    stationary: bool = False
    state: State

    _norm = field_validator("orientation")(unit_quaternion)


class BodyJoint(Pose):
    """One joint of hips and legs.

    A joint's frame has +X to the body's right, +Y along the bone towards the hips and +Z backwards when the person
    stands upright; a knee's frame is that of the shank, an ankle's and a foot's that of the foot.
    """


class LegAngles(WireModel):
    """Joint angles of one leg, radians, all 0 when standing upright.

    Attributes:
        hip_flexion: of the thigh, forwards positive.
        hip_abduction: of the thigh, away from the other leg positive.
        hip_rotation: of the thigh about itself, toes outwards positive.
        knee_flexion: never negative.
        ankle_flexion: toes upwards positive.
    """

    hip_flexion: float
    hip_abduction: float
    hip_rotation: float
    knee_flexion: float
    ankle_flexion: float


class BodyPose(Message):
    """Hips and legs, from ik.

    Attributes:
        frame: frame of all positions and orientations.
        joints: `hips`, and for `left` and `right`: `<side>_hip`, `<side>_knee`, `<side>_ankle`, `<side>_foot` (the ball
            of the foot).
        angles: joint angles per leg.
        legs: per leg whether its foot is measured or predicted; a leg of which nothing is known is absent.
        state: measured while the head and at least one foot are.
    """

    frame: Name
    joints: Annotated[dict[Name, BodyJoint], Field(max_length=32)]
    angles: Annotated[dict[Side, LegAngles], Field(max_length=2)]
    legs: Annotated[dict[Side, State], Field(max_length=2)]
    state: State
