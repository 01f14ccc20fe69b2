"""Feet, and the body that follows from them, the head and the hands."""

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
    """One joint of the body.

    A joint's frame has +X to the body's right, +Y up and +Z backwards when the person stands upright with hanging arms
    and palms towards the thighs. It moves with the bone that begins at the joint, along +Y or −Y: a knee's frame is
    that of the shank, an ankle's and a foot's that of the foot, a shoulder's that of the upper arm, an elbow's that of
    the forearm, a wrist's that of the hand.
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
    """A body, from ik: hips, legs, trunk, head and, of hands that are tracked, arms.

    Head, feet and wrists are measured; `inferred` names the joints between them, which follow by the person's lengths
    and by how people stand.

    Attributes:
        frame: frame of all positions and orientations.
        joints: `hips`, and for `left` and `right`: `<side>_hip`, `<side>_knee`, `<side>_ankle`, `<side>_foot` (the ball
            of the foot). Above the hips `spine_lower`, `chest`, `neck`, `head` (the skull's base), and for a tracked
            hand `<side>_shoulder`, `<side>_elbow`, `<side>_wrist`. OpenXR's names (XR_FB_body_tracking,
            XR_BD_body_tracking).
        angles: joint angles per leg.
        legs: per leg whether its foot is measured or predicted; a leg of which nothing is known is absent.
        arms: per arm whether its hand is measured or predicted; an arm whose hand is not tracked is absent.
        inferred: joints that nothing measures.
        state: measured while the head and at least one foot are.
    """

    frame: Name
    joints: Annotated[dict[Name, BodyJoint], Field(max_length=32)]
    angles: Annotated[dict[Side, LegAngles], Field(max_length=2)]
    legs: Annotated[dict[Side, State], Field(max_length=2)]
    arms: Annotated[dict[Side, State], Field(max_length=2)] = {}
    inferred: Annotated[tuple[Name, ...], Field(max_length=32)] = ()
    state: State
