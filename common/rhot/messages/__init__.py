"""The wire schemas: the message of each key and its encoding.

A payload is a msgpack map of one of the models of this package; the Zenoh encoding is `application/msgpack` with the
model's name as suffix (`application/msgpack;MarkerFrame`). SI units throughout: metres, seconds, radians;
pixels with u to the right and v down, pixel centres on integers, in the raw (distorted) image. Quaternions are
(x, y, z, w) of unit norm. Times are integer nanoseconds since the Unix epoch on the rig clock.

Unknown fields are ignored, so that an older reader accepts messages of a newer sender. A missing field, or a value that
has the wrong type, is not finite or is out of bounds, makes the message invalid (`WireError`).
"""

from __future__ import annotations

from rhot.messages.base import (
    SCHEMA_VERSION,
    Count,
    Message,
    Name,
    PixelPoint,
    Pose,
    Position,
    Quaternion,
    WireModel,
    first_problem,
)
from rhot.messages.codec import MAX_PAYLOAD_BYTES, decode, encode, encoding_of, unpack, with_seq
from rhot.messages.services import ClockReply, Control, ServiceStatus
from rhot.messages.tracked import (
    BodyJoint,
    BodyPose,
    BoxShape,
    CylinderShape,
    Event,
    FacedShape,
    FingerAngles,
    FootPose,
    HandPose,
    HeadPose,
    Joint,
    LegAngles,
    Marker,
    MarkerFrame,
    MeshShape,
    ObjectPose,
    ObjectShape,
    Point,
    PointSet,
    Space,
    SphereShape,
    TruePose,
    Truth,
)
from rhot.types import PointState, Side, State

__all__ = [
    "MAX_PAYLOAD_BYTES",
    "SCHEMA_VERSION",
    "BodyJoint",
    "BodyPose",
    "BoxShape",
    "ClockReply",
    "Control",
    "Count",
    "CylinderShape",
    "Event",
    "FacedShape",
    "FingerAngles",
    "FootPose",
    "HandPose",
    "HeadPose",
    "Joint",
    "LegAngles",
    "Marker",
    "MarkerFrame",
    "MeshShape",
    "Message",
    "Name",
    "ObjectPose",
    "ObjectShape",
    "PixelPoint",
    "Point",
    "PointSet",
    "PointState",
    "Pose",
    "Position",
    "Quaternion",
    "ServiceStatus",
    "Side",
    "Space",
    "SphereShape",
    "State",
    "TruePose",
    "Truth",
    "WireModel",
    "decode",
    "encode",
    "encoding_of",
    "first_problem",
    "unpack",
    "with_seq",
]
