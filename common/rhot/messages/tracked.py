"""What is tracked, as messages: markers and points, hands, feet and body, objects and headset, spaces."""

from __future__ import annotations

import math
from typing import Annotated, Final, Literal

import numpy as np
from pydantic import Field, field_validator

from rhot.messages.base import (
    Count,
    Label,
    Listed,
    Message,
    Name,
    Pixel,
    PixelPoint,
    Pose,
    Position,
    Quaternion,
    Seconds,
    SignedUnit,
    TimeNs,
    Unit,
    WireModel,
    unit_quaternion,
)
from rhot.types import PointState, Side, State

# Markers in images, and as points in space.

SquareMetres = Annotated[float, Field(ge=-1e6, le=1e6)]
Covariance = Annotated[
    tuple[SquareMetres, SquareMetres, SquareMetres, SquareMetres, SquareMetres, SquareMetres], Listed
]


class Marker(WireModel):
    """One marker in one camera's image.

    Attributes:
        u, v: sub-pixel centre, pixels, raw image.
        area: visible area, square pixels.
        score: probability that the identity is right and the centre within one pixel of the true one.
        t_ns: mid-exposure of the marker's image row, if it differs from the frame's `t_ns`.
        corners: the four corners of a rectangular patch in cyclic order, pixels.
        outline: closed outline, pixels.
        skin_side: where skin adjoins the paint, in the image: mean over a ring around the blob of the unit vectors from
            the centre, those to other than skin counting 0. Its length is 0 where none adjoins, or on all sides alike,
            and 0.32 where it does along half of the ring. Absent if the colour of the skin is not known.
    """

    u: Pixel
    v: Pixel
    area: Annotated[float, Field(ge=0.0, le=1e9)]
    score: Unit
    t_ns: TimeNs | None = None
    corners: Annotated[tuple[PixelPoint, PixelPoint, PixelPoint, PixelPoint], Listed] | None = None
    outline: Annotated[tuple[PixelPoint, ...], Field(max_length=512), Listed] | None = None
    skin_side: Annotated[tuple[SignedUnit, SignedUnit], Listed] | None = None


class MarkerFrame(Message):
    """All markers detected in one frame of one camera; a marker that was not seen is absent.

    Attributes:
        camera: name of the camera in `rig.toml`.
        width, height: size of the image, pixels.
        markers: observations by marker name.
        timing: seconds of the capture service: `age`, from mid-exposure of the middle row to the start of
            detection, and `detect`, duration of the detection.
        frame: the source's frame counter; a gap means frames lost before detection.
    """

    camera: Name
    width: Annotated[int, Field(gt=0, le=65536)]
    height: Annotated[int, Field(gt=0, le=65536)]
    markers: Annotated[dict[Name, Marker], Field(max_length=256)]
    timing: Annotated[dict[Name, Seconds], Field(max_length=32)] = {}
    frame: Count = 0


class Point(WireModel):
    """One marker in space.

    Attributes:
        position: metres, in the frame of the PointSet.
        covariance: of the position, xx, xy, xz, yy, yz, zz, square metres; absent if the method estimates none.
        sigma: standard deviation of the position, metres (root of the sum of the three variances).
        views: number of cameras that see the marker.
        state: `measured` (two or more views at this time), `one_view` (on one camera's ray: uncertain along it) or
            `predicted`.
        corners: corners of a rectangular patch, metres, cyclic order.
    """

    position: Position
    sigma: Annotated[float, Field(ge=0.0, le=1e3)]
    views: Annotated[int, Field(ge=0, le=255)]
    state: PointState
    covariance: Covariance | None = None
    corners: Annotated[tuple[Position, Position, Position, Position], Listed] | None = None


class PointSet(Message):
    """All marker points at one time, from fusion.

    Attributes:
        frame: frame of all positions, `rig`.
        points: by marker name; an unknown marker is absent.
    """

    frame: Name
    points: Annotated[dict[Name, Point], Field(max_length=256)]


# Feet, and the body computed from feet, head and hands.


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
    velocity: Annotated[tuple[float, float, float], Listed]
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
    inferred: Annotated[tuple[Name, ...], Field(max_length=32), Listed] = ()
    state: State


# A hand.


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
        sigma: standard deviation of each joint's position, metres (root of the sum of the three variances); a joint
            whose uncertainty is not known is absent.
        angle_sigma: standard deviation of the angles per finger, radians; absent if not known.
        state: `measured` when the palm and at least one finger are measured.
    """

    side: Side
    frame: Name
    joints: Annotated[dict[Name, Joint], Field(max_length=64)]
    angles: Annotated[dict[Name, FingerAngles], Field(max_length=8)]
    residual: Annotated[dict[Name, Annotated[float, Field(ge=0.0, le=1e3)]], Field(max_length=8)]
    fingers: Annotated[dict[Name, State], Field(max_length=8)] = {}
    sigma: Annotated[dict[Name, Annotated[float, Field(ge=0.0, le=1e3)]], Field(max_length=64)] = {}
    angle_sigma: Annotated[dict[Name, FingerAngles], Field(max_length=8)] = {}
    state: State


# Further frames with a known pose in the rig frame: the floor, a tracking system's space.

Row = Annotated[tuple[float, float, float, float], Listed]
Matrix4 = Annotated[tuple[Row, Row, Row, Row], Listed]


class Space(Message):
    """A further frame and its pose in the rig frame.

    Attributes:
        T_rig_space: rigid transform that maps coordinates of the space to the rig frame; 4x4 by rows, metres.
        source: method of its calibration, such as `steamvr registration` or `desk board`.
        residual_m: residual of the calibration, metres; absent if not known.
    """

    T_rig_space: Matrix4
    source: Label
    residual_m: Annotated[float, Field(ge=0.0, le=1e3)] | None = None

    @field_validator("T_rig_space")
    @classmethod
    def _rigid(cls, value: Matrix4) -> Matrix4:
        T = np.array(value)
        R = T[:3, :3]
        if (T[3] != (0.0, 0.0, 0.0, 1.0)).any():
            raise ValueError("the last row of T_rig_space must be 0 0 0 1")
        orthonormal = 1e-3
        if float(np.abs(R @ R.T - np.eye(3)).max()) > orthonormal or float(np.linalg.det(R)) < 0.0:
            raise ValueError("T_rig_space is no rigid transform: its rotation is not orthonormal and right-handed")
        if float(np.abs(T[:3, 3]).max()) > 1e3:
            raise ValueError("T_rig_space moves by more than 1000 m")
        return value


# Ground truth of a simulated world.


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


# Tracked objects and the headset.

Size = Annotated[float, Field(gt=0.0, le=10.0)]
"""Length of an edge, radius or height, metres."""


class BoxShape(WireModel):
    """A cuboid.

    Attributes:
        kind: type of the shape.
        size: edges along the object's x, y, z, metres.
    """

    kind: Literal["box"] = "box"
    size: Annotated[tuple[Size, Size, Size], Listed]


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

Plane = Annotated[tuple[float, float, float, float], Listed]
"""Outward unit normal, and the plane's distance from the middle along it, metres."""


class MeshShape(WireModel):
    """A mesh from a file of the rig folder; who has no such file meets its convex hull.

    Attributes:
        kind: type of the shape.
        file: name of the file with its surface, glTF.
        size: edges of its bounding box along the object's x, y, z, metres; the object's frame has the file's axes (y
            up) and its origin in the middle of that box.
        planes: of its convex hull: outward unit normal x, y, z and distance from the middle, metres.
    """

    kind: Literal["mesh"] = "mesh"
    file: Label
    size: Annotated[tuple[Size, Size, Size], Listed]
    planes: Annotated[tuple[Plane, ...], Field(min_length=4, max_length=MOST_PLANES), Listed]

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


# Marked moments.


class Event(Message):
    """A moment that somebody marked, such as the start of a trial or a trigger.

    Attributes:
        label: what happened, one of the experimenter's own words.
        source: who marked it: `mark`, `page`, `lsl`, `gpio`, or the name of a program.
        uncertainty_s: how far `t_ns` may be off, seconds; absent if not known.
    """

    label: Label
    source: Label
    uncertainty_s: Annotated[float, Field(ge=0.0, le=1e6)] | None = None
