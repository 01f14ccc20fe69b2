"""The wire schemas: what travels on which key, and its exact encoding.

A payload is a msgpack map of one of the models below; the Zenoh encoding is `application/msgpack` with the
model's name as suffix (`application/msgpack;MarkerFrame`). SI units throughout: metres, seconds, radians;
pixels with u to the right and v down, pixel centres on integers, in the raw (distorted) image. Quaternions are
(x, y, z, w) of unit norm. Times are integer nanoseconds since the Unix epoch on the rig clock.

Unknown fields are ignored so that a newer sender may talk to an older reader; anything missing, wrong-typed,
not finite or out of bounds makes the message invalid (`WireError`).
"""

from __future__ import annotations

import math
from typing import Annotated, Any, Final, Literal, TypeVar

import msgpack
from pydantic import BaseModel, ConfigDict, Field, ValidationError, field_validator

from rhot.errors import WireError

SCHEMA_VERSION: Final = 1
MAX_PAYLOAD_BYTES: Final = 1 << 20
"""Largest payload that is decoded; a full HandPose takes about 3 kB."""

_QUATERNION_NORM_TOLERANCE: Final = 1e-3

Name = Annotated[str, Field(pattern=r"^[A-Za-z0-9_.-]{1,64}$")]
"""A camera, marker, joint, object or service name: it can stand as one chunk of a key."""
TimeNs = Annotated[int, Field(ge=0, lt=1 << 63)]
Count = Annotated[int, Field(ge=0, lt=1 << 63)]
Pixel = Annotated[float, Field(ge=-1e5, le=1e5)]
Metres = Annotated[float, Field(ge=-1e3, le=1e3)]
Seconds = Annotated[float, Field(ge=-1e6, le=1e6)]
Unit = Annotated[float, Field(ge=0.0, le=1.0)]

PixelPoint = tuple[Pixel, Pixel]
Position = tuple[Metres, Metres, Metres]
Quaternion = tuple[float, float, float, float]

State = Literal["measured", "predicted"]
"""`measured`: backed by an observation of this moment; `predicted`: bridged by a model."""
Side = Literal["left", "right"]


class WireModel(BaseModel):
    """Base of messages and their parts: frozen, finite, strict about types, tolerant of unknown fields."""

    model_config = ConfigDict(frozen=True, extra="ignore", strict=True, allow_inf_nan=False)


class Message(WireModel):
    """What every message carries.

    Attributes:
        t_ns: the moment the sample was true, rig clock.
        seq: counts the publisher's messages on this key from 0, so that gaps can be counted.
        schema_version: version of the model.
    """

    t_ns: TimeNs
    seq: Count = 0
    schema_version: Literal[1] = SCHEMA_VERSION


def _unit_quaternion(value: Quaternion) -> Quaternion:
    x, y, z, w = value
    norm = math.sqrt(x * x + y * y + z * z + w * w)
    if abs(norm - 1.0) > _QUATERNION_NORM_TOLERANCE:
        raise ValueError(f"quaternion (x, y, z, w) has norm {norm:.6g}, must be 1")
    return value


class Marker(WireModel):
    """One marker as one camera saw it.

    Attributes:
        u, v: sub-pixel centre, pixels, raw image.
        area: visible area, square pixels.
        score: 0 to 1, how surely this is the marker.
        t_ns: mid-exposure of the marker's own row where it differs from the frame's `t_ns`.
        corners: the four corners of a rectangular patch in cyclic order, pixels.
        outline: closed outline, pixels.
    """

    u: Pixel
    v: Pixel
    area: Annotated[float, Field(ge=0.0, le=1e9)]
    score: Unit
    t_ns: TimeNs | None = None
    corners: tuple[PixelPoint, PixelPoint, PixelPoint, PixelPoint] | None = None
    outline: Annotated[tuple[PixelPoint, ...], Field(max_length=512)] | None = None


class MarkerFrame(Message):
    """All markers found in one frame of one camera; a marker that was not seen is absent.

    Attributes:
        camera: name of the camera as in `rig.toml`.
        width, height: size of the image, pixels.
        markers: marker name to its observation.
        timing: seconds spent per stage of the capture service, such as `wait`, `classify`, `locate`.
        frame: the source's own frame counter; a gap means frames lost before detection.
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
        position: metres, in the frame that the PointSet names.
        sigma: standard deviation of the position, metres (root of the sum of the three variances).
        views: number of cameras behind it.
        state: measured or predicted.
        corners: corners of a rectangular patch, metres, cyclic order.
    """

    position: Position
    sigma: Annotated[float, Field(ge=0.0, le=1e3)]
    views: Annotated[int, Field(ge=0, le=255)]
    state: State
    corners: tuple[Position, Position, Position, Position] | None = None


class PointSet(Message):
    """All marker points at one moment, from fusion.

    Attributes:
        frame: frame of all positions, `rig`.
        points: by marker name; a marker of which nothing is known is absent.
    """

    frame: Name
    points: Annotated[dict[Name, Point], Field(max_length=256)]


class Pose(WireModel):
    """A place and an orientation.

    Attributes:
        position: metres.
        orientation: unit quaternion x, y, z, w.
    """

    position: Position
    orientation: Quaternion

    _norm = field_validator("orientation")(_unit_quaternion)


class Joint(Pose):
    """One joint of the hand.

    Attributes:
        orientation: unit quaternion x, y, z, w; OpenXR axes, +Z from tip to wrist, +Y out of the back of the hand.
        radius: of the flesh around it, metres.
    """

    radius: Annotated[float, Field(ge=0.0, le=1.0)]


class FingerAngles(WireModel):
    """Joint angles of one finger, radians; flexion is positive towards the palm.

    Attributes:
        mcp_flexion, mcp_abduction: at the knuckle; abduction is positive towards the thumb's side.
        pip_flexion, dip_flexion: at the middle and the last hinge.
    """

    mcp_flexion: float
    mcp_abduction: float
    pip_flexion: float
    dip_flexion: float


class HandPose(Message):
    """One hand, from ik.

    Attributes:
        side: whose hand.
        frame: frame of all positions and orientations.
        joints: the 26 OpenXR joints by name.
        angles: joint angles per finger; the thumb's MCP stands for its carpometacarpal joint, its PIP for the
            metacarpophalangeal and its DIP for the interphalangeal joint.
        residual: distance between each finger's measured and modelled marker, metres; absent when not measured.
        fingers: per finger whether its pose is measured or predicted.
        state: measured when the palm and at least one finger are measured.
    """

    side: Side
    frame: Name
    joints: Annotated[dict[Name, Joint], Field(max_length=64)]
    angles: Annotated[dict[Name, FingerAngles], Field(max_length=8)]
    residual: Annotated[dict[Name, Annotated[float, Field(ge=0.0, le=1e3)]], Field(max_length=8)]
    fingers: Annotated[dict[Name, State], Field(max_length=8)] = {}
    state: State


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

    _norm = field_validator("orientation")(_unit_quaternion)


class HeadPose(ObjectPose):
    """Pose of the headset."""


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
            sensor alone, or nothing (`lost`: the last place is held).
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

    _norm = field_validator("orientation")(_unit_quaternion)


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


class Control(Message):
    """The broadcast that starts and stops all services.

    Attributes:
        action: `start` or `stop`.
        session: identifies the run; a stop without a session stops whatever runs.
        start_t_ns: rig time at which everybody starts; it lies in the future when the message is sent, so that
            all cameras begin with the same moment.
    """

    action: Literal["start", "stop"]
    session: Annotated[str, Field(max_length=64)] = ""
    start_t_ns: TimeNs = 0


class ClockReply(Message):
    """Answer to a clock query: two of the four timestamps of the exchange.

    Attributes:
        t_ns: rig time when the answer left.
        received_t_ns: rig time when the query arrived.
        instance: identifies the clock, so that a restart of the machine that owns it is noticed.
    """

    received_t_ns: TimeNs
    instance: Name


class ServiceStatus(Message):
    """Once a second from every service.

    Attributes:
        service, instance: who.
        state: what it does now.
        session: id of the running session.
        uptime_s: seconds since the process started.
        rates: events per second over the last interval, by name.
        counts: events since start, by name: `invalid`, `dropped_late`, `missed`, …
        latency_s: percentiles over the last seconds, by stage: `{"total": {"p50": …, "p99": …}}`.
        figures: other figures of this kind of service, such as `epipolar_px`, the mean epipolar residual.
        problem: what is wrong with the rig as a whole right now, one sentence; empty when nothing is.
        last_error: newest error, empty when none.
        config_digest: changes when the configuration does.
        clock_offset_s: rig clock minus this node's clock.
        clock_uncertainty_s: bound of the remaining error of that offset; absent before the first exchange.
    """

    service: Name
    instance: Name
    state: Literal["starting", "waiting", "running", "stopping"]
    session: str = ""
    uptime_s: Annotated[float, Field(ge=0.0)] = 0.0
    rates: Annotated[dict[Name, float], Field(max_length=256)] = {}
    counts: Annotated[dict[Name, Count], Field(max_length=256)] = {}
    latency_s: Annotated[dict[Name, dict[Name, float]], Field(max_length=64)] = {}
    figures: Annotated[dict[Name, float], Field(max_length=64)] = {}
    problem: Annotated[str, Field(max_length=4096)] = ""
    last_error: Annotated[str, Field(max_length=4096)] = ""
    config_digest: str = ""
    clock_offset_s: float | None = None
    clock_uncertainty_s: float | None = None


class TruePose(Pose):
    """A pose of the simulated world."""


class Truth(Message):
    """What is true in the simulated world, rig frame.

    Attributes:
        frame: frame of all poses, `rig`.
        points: centre of each marker's painted volume.
        hands: side to OpenXR joint name to pose.
        objects: object id to pose.
        head: pose of the headset.
        feet: side to the pose of the foot as in `FootPose`.
        body: joint name to pose as in `BodyPose`.
    """

    frame: Name
    points: Annotated[dict[Name, Position], Field(max_length=256)]
    hands: Annotated[dict[Name, dict[Name, TruePose]], Field(max_length=2)]
    objects: Annotated[dict[Name, TruePose], Field(max_length=64)]
    head: TruePose | None = None
    feet: Annotated[dict[Side, TruePose], Field(max_length=2)] = {}
    body: Annotated[dict[Name, TruePose], Field(max_length=32)] = {}


M = TypeVar("M", bound=Message)


def encoding_of(model: type[Message]) -> str:
    """Return the Zenoh encoding that carries a model's payloads."""
    return f"application/msgpack;{model.__name__}"


def encode(message: Message) -> bytes:
    """Return the msgpack payload of a message; fields that are None are left out."""
    packed: bytes = msgpack.packb(message.model_dump(mode="python", exclude_none=True))
    return packed


def unpack(payload: bytes) -> Any:
    """Return the plain Python value of a msgpack payload, arrays as tuples.

    Raises:
        WireError: the payload is too large or not msgpack.
    """
    if len(payload) > MAX_PAYLOAD_BYTES:
        raise WireError(f"payload of {len(payload)} bytes is over the limit of {MAX_PAYLOAD_BYTES}")
    try:
        return msgpack.unpackb(payload, use_list=False, strict_map_key=True)
    except (ValueError, TypeError, OverflowError, RecursionError, msgpack.UnpackException) as error:
        raise WireError(f"payload of {len(payload)} bytes is not msgpack: {error or type(error).__name__}") from error


def decode(payload: bytes, model: type[M]) -> M:
    """Return the message in a payload.

    Raises:
        WireError: not msgpack, or not a valid `model`; names the first offending field.
    """
    try:
        return model.model_validate(unpack(payload))
    except ValidationError as error:
        raise WireError(f"not a valid {model.__name__}: {first_problem(error)}") from error


def first_problem(error: ValidationError) -> str:
    """Return one line that names the first offending field of a validation error, its value and how many more."""
    problems = error.errors(include_url=False)
    first = problems[0]
    where = ".".join(str(part) for part in first["loc"]) or "(whole)"
    text = f"{where}: {first['msg'].removeprefix('Value error, ')}"
    if first["type"] != "missing":
        text += f", got {_short(first['input'])}"
    return text if len(problems) == 1 else f"{text} (and {len(problems) - 1} more)"


def _short(value: object) -> str:
    text = repr(value)
    return text if len(text) <= 80 else f"{text[:77]}…"


def with_seq(message: M, seq: int) -> M:
    """Return the message with its sequence number set; publishers call it."""
    return message.model_copy(update={"seq": seq})


__all__ = [
    "SCHEMA_VERSION",
    "BodyJoint",
    "BodyPose",
    "ClockReply",
    "Control",
    "FingerAngles",
    "FootPose",
    "HandPose",
    "HeadPose",
    "Joint",
    "LegAngles",
    "Marker",
    "MarkerFrame",
    "Message",
    "ObjectPose",
    "Point",
    "PointSet",
    "ServiceStatus",
    "Side",
    "State",
    "TruePose",
    "Truth",
    "decode",
    "encode",
    "encoding_of",
    "first_problem",
    "unpack",
    "with_seq",
]
