"""Feet, and the body computed from feet, head and hands."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field, field_validator

from rhot.messages.base import Message, Name, Pose, Position, Quaternion, Side, State, WireModel, unit_quaternion


class FootPose(Message):
    """One foot, from the feet service.

    The foot's frame has its origin in the centre of the foot's marker, +X to the foot's right, +Y up out of the instep
    and +Z from the toes to the heel.

    Attributes:
        side: left or right foot.
        frame: frame of all vectors, `rig`.
        position: metres.
        orientation: unit quaternion x, y, z, w, foot frame to `frame`.
        velocity: metres per second.
        sigma: standard deviation of the position, metres (root of the sum of the three variances).
        stage: best recent measurement: the `marker`, the foot's blob in the `depth` image, the `inertial` sensor alone,
            or none (`lost`: the last position is held).
        stationary: whether the foot stands still.
        state: `measured` while marker, depth image or zero velocity confirm the position, else `predicted`.
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

    When the person stands upright with hanging arms and palms towards the thighs, a joint's frame has +X to the body's
    right, +Y up and +Z backwards. It is fixed to the bone that starts at the joint, along +Y or −Y: a knee's frame to
    the shank, an ankle's and a foot's to the foot, a shoulder's to the upper arm, an elbow's to the forearm, a wrist's
    to the hand.
    """


class LegAngles(WireModel):
    """Joint angles of one leg, radians, all 0 when standing upright.

    Attributes:
        hip_flexion: of the thigh, positive forwards.
        hip_abduction: of the thigh, positive away from the other leg.
        hip_rotation: of the thigh about its own axis, positive with the toes outwards.
        knee_flexion: never negative.
        ankle_flexion: dorsiflexion, positive with the toes upwards.
    """

    hip_flexion: float
    hip_abduction: float
    hip_rotation: float
    knee_flexion: float
    ankle_flexion: float


class BodyPose(Message):
    """A body, from ik: hips, legs, trunk, head, and the arms of tracked hands.

    Head, feet and wrists are measured; `inferred` names the joints between them, which are computed from the person's
    segment lengths and typical postures.

    Attributes:
        frame: frame of all positions and orientations.
        joints: `hips`, and for `left` and `right`: `<side>_hip`, `<side>_knee`, `<side>_ankle`, `<side>_foot` (the ball
            of the foot). Above the hips `spine_lower`, `chest`, `neck`, `head` (the skull's base), and for a tracked
            hand `<side>_shoulder`, `<side>_elbow`, `<side>_wrist`. OpenXR's names (XR_FB_body_tracking,
            XR_BD_body_tracking).
        angles: joint angles per leg.
        legs: state of each leg's foot; an unknown leg is absent.
        arms: state of each arm's hand; an arm whose hand is not tracked is absent.
        inferred: joints that are not measured.
        state: `measured` while the head and at least one foot are measured.
    """

    frame: Name
    joints: Annotated[dict[Name, BodyJoint], Field(max_length=32)]
    angles: Annotated[dict[Side, LegAngles], Field(max_length=2)]
    legs: Annotated[dict[Side, State], Field(max_length=2)]
    arms: Annotated[dict[Side, State], Field(max_length=2)] = {}
    inferred: Annotated[tuple[Name, ...], Field(max_length=32)] = ()
    state: State
