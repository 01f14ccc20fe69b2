"""The messages that Foxglove and Lichtblick draw, as far as they are used here, with their JSON schemas.

Each model stands for the schema `foxglove.<its name>` (https://docs.foxglove.dev/docs/sdk/schemas): colours are
0 to 1, lengths metres, image coordinates pixels from the upper left corner of the upper left pixel.
"""

from __future__ import annotations

import json
from functools import cache
from typing import Annotated, Any, Final, Literal

from pydantic import BaseModel, ConfigDict, Field

PREFIX: Final = "foxglove."


class FoxgloveModel(BaseModel):
    """Base of all: built by this program alone, so nothing is checked twice."""

    model_config = ConfigDict(frozen=True)


class Time(FoxgloveModel):
    """Seconds and nanoseconds; a moment since the Unix epoch, or a duration."""

    sec: int
    nsec: int

    @classmethod
    def of(cls, t_ns: int) -> Time:
        """Return nanoseconds as Foxglove has them."""
        return cls(sec=t_ns // 1_000_000_000, nsec=t_ns % 1_000_000_000)


class Vector3(FoxgloveModel):
    """A point, a vector or an extent."""

    x: float
    y: float
    z: float


class Quaternion(FoxgloveModel):
    """A rotation."""

    x: float
    y: float
    z: float
    w: float


class Point2(FoxgloveModel):
    """A place in a picture."""

    x: float
    y: float


class Color(FoxgloveModel):
    """Red, green, blue, opacity."""

    r: float
    g: float
    b: float
    a: float = 1.0


class Pose(FoxgloveModel):
    """A place and an orientation."""

    position: Vector3
    orientation: Quaternion = Quaternion(x=0.0, y=0.0, z=0.0, w=1.0)


class KeyValuePair(FoxgloveModel):
    """A note."""

    key: str
    value: str


class SpherePrimitive(FoxgloveModel):
    """A ball; `size` is its diameter."""

    pose: Pose
    size: Vector3
    color: Color


class LinePrimitive(FoxgloveModel):
    """Lines between pairs of points."""

    type: Literal[2] = 2
    pose: Pose = Pose(position=Vector3(x=0.0, y=0.0, z=0.0))
    thickness: float
    scale_invariant: bool = False
    points: list[Vector3]
    color: Color
    colors: list[Color] = []
    indices: list[int] = []


class TextPrimitive(FoxgloveModel):
    """A label that faces who looks."""

    pose: Pose
    billboard: bool = True
    font_size: float
    scale_invariant: bool = True
    color: Color
    text: str


class Unused(FoxgloveModel):
    """Stands for primitives that are not used here; their lists are there, and empty."""


class SceneEntity(FoxgloveModel):
    """Something to see; replaces what had the same id on the same topic."""

    timestamp: Time
    frame_id: str
    id: str
    lifetime: Time
    frame_locked: bool = True
    metadata: list[KeyValuePair] = []
    arrows: list[Unused] = []
    cubes: list[Unused] = []
    spheres: list[SpherePrimitive] = []
    cylinders: list[Unused] = []
    lines: list[LinePrimitive] = []
    triangles: list[Unused] = []
    texts: list[TextPrimitive] = []
    models: list[Unused] = []


class SceneUpdate(FoxgloveModel):
    """What is to be seen from now on."""

    deletions: list[Unused] = []
    entities: list[SceneEntity]


class FrameTransform(FoxgloveModel):
    """Where a child frame lies in its parent."""

    timestamp: Time
    parent_frame_id: str
    child_frame_id: str
    translation: Vector3
    rotation: Quaternion


class FrameTransforms(FoxgloveModel):
    """Several transforms."""

    transforms: list[FrameTransform]


class PoseInFrame(FoxgloveModel):
    """A pose."""

    timestamp: Time
    frame_id: str
    pose: Pose


class CompressedImage(FoxgloveModel):
    """A picture; `data` is base64."""

    timestamp: Time
    frame_id: str
    data: Annotated[str, Field(json_schema_extra={"contentEncoding": "base64"})]
    format: str


class CameraCalibration(FoxgloveModel):
    """Lens and size of a camera."""

    timestamp: Time
    frame_id: str
    width: int
    height: int
    distortion_model: str
    D: list[float]
    K: list[float]
    R: list[float]
    P: list[float]


class CircleAnnotation(FoxgloveModel):
    """A circle in a picture."""

    timestamp: Time
    position: Point2
    diameter: float
    thickness: float
    fill_color: Color
    outline_color: Color
    metadata: list[KeyValuePair] = []


class TextAnnotation(FoxgloveModel):
    """A label in a picture."""

    timestamp: Time
    position: Point2
    text: str
    font_size: float
    text_color: Color
    background_color: Color
    metadata: list[KeyValuePair] = []


class ImageAnnotations(FoxgloveModel):
    """What is drawn over a picture."""

    circles: list[CircleAnnotation]
    points: list[Unused] = []
    texts: list[TextAnnotation]


def schema_name(model: type[FoxgloveModel]) -> str:
    """Return the name by which Foxglove knows a message."""
    return f"{PREFIX}{model.__name__}"


@cache
def schema_json(model: type[FoxgloveModel]) -> bytes:
    """Return a message's JSON schema without references, which not every reader follows."""
    schema = model.model_json_schema(mode="serialization")
    return json.dumps(_inlined(schema, schema.pop("$defs", {})) | {"title": schema_name(model)}).encode()


def _inlined(value: Any, parts: dict[str, Any]) -> Any:
    if isinstance(value, list):
        return [_inlined(item, parts) for item in value]
    if not isinstance(value, dict):
        return value
    if "$ref" in value:
        return _inlined(parts[value["$ref"].rpartition("/")[2]], parts)
    return {name: _inlined(item, parts) for name, item in value.items() if name != "default"}
