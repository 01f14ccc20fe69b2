"""Hands as NVIDIA Isaac Teleop records them: an MCAP file that its `ReplaySession` plays.

Each hand is a channel, `hands/left_hand` or `hands/right_hand`, of FlatBuffers messages `core.HandPoseRecord`: 26
joints in OpenXR's order and axes. The schema lies beside them in binary (as `flatc --schema` writes it and FlatBuffers'
`reflection.fbs` describes it), and Isaac compares it with its own. Names and layout are those of isaacteleop 1.5.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, Final, NamedTuple

import numpy as np

from rhot import __version__
from rhot.anatomy.skeleton import JOINTS
from rhot.atomic_file import replacing
from rhot.errors import ConfigError
from rhot.geometry.rotations import quaternion_from_rotation
from rhot.plugins import load_library
from rhot_tools.export.poses import ExportedMotion

BASE: Final = "hands"
"""Name that `McapReplayConfig` maps a hand tracker to."""
JOINT: Final = np.dtype(
    [("position", "<f4", 3), ("orientation", "<f4", 4), ("is_valid", "?"), ("_", "V3"), ("radius", "<f4")]
)
"""`core.HandJointPose`; its orientation is x, y, z, w."""
_ROOT: Final = "core.HandPoseRecord"
_ALIGNMENT: Final = 8
"""Of the times in a record."""

# The schema, as reflection.fbs numbers things.

_BOOL, _LONG, _FLOAT, _OBJECT, _ARRAY = 2, 9, 11, 15, 17
_BYTES: Final = {_BOOL: 1, _LONG: 8, _FLOAT: 4, _OBJECT: 4, _ARRAY: 4}


class _Field(NamedTuple):
    """A field: of which kind, at which offset (of a table: in its vtable), of which object, how many, padding after."""

    name: str
    kind: int
    offset: int
    object: str = ""
    length: int = 0
    padding: int = 0


class _Object(NamedTuple):
    """A structure, or where `bytes` is 0 a table."""

    name: str
    file: str
    fields: Sequence[_Field]
    alignment: int = 1
    bytes: int = 0


def _floats(names: str) -> list[_Field]:
    return [_Field(name, _FLOAT, 4 * index) for index, name in enumerate(names)]


_OBJECTS: Final = (
    _Object(
        "core.DeviceDataTimestamp",
        "//timestamp.fbs",
        [
            _Field("available_time_local_common_clock", _LONG, 0),
            _Field("sample_time_local_common_clock", _LONG, 8),
            _Field("sample_time_raw_device_clock", _LONG, 16),
        ],
        8,
        24,
    ),
    _Object(
        "core.HandJointPose",
        "//hand.fbs",
        [
            _Field("pose", _OBJECT, 0, "core.Pose"),
            _Field("is_valid", _BOOL, 28, padding=3),
            _Field("radius", _FLOAT, 32),
        ],
        4,
        JOINT.itemsize,
    ),
    _Object(
        "core.HandJoints",
        "//hand.fbs",
        [_Field("poses", _ARRAY, 0, "core.HandJointPose", len(JOINTS))],
        4,
        len(JOINTS) * JOINT.itemsize,
    ),
    _Object("core.HandPose", "//hand.fbs", [_Field("joints", _OBJECT, 4, "core.HandJoints")]),
    _Object(
        _ROOT,
        "//hand.fbs",
        [_Field("data", _OBJECT, 4, "core.HandPose"), _Field("timestamp", _OBJECT, 6, "core.DeviceDataTimestamp")],
    ),
    _Object("core.Point", "//point.fbs", _floats("xyz"), 4, 12),
    _Object(
        "core.Pose",
        "//pose.fbs",
        [_Field("position", _OBJECT, 0, "core.Point"), _Field("orientation", _OBJECT, 12, "core.Quaternion")],
        4,
        28,
    ),
    _Object("core.Quaternion", "//quaternion.fbs", _floats("xyzw"), 4, 16),
)


def _builder() -> Any:
    return load_library("flatbuffers", "--isaac", "isaac").Builder(1024)


def schema() -> bytes:
    """Return the binary schema of `core.HandPoseRecord`."""
    builder = _builder()
    texts = {
        text: builder.CreateString(text)
        for item in _OBJECTS
        for text in (item.name, item.file, *(field.name for field in item.fields))
    }
    empty = builder.CreateString("")
    numbers = {item.name: number for number, item in enumerate(_OBJECTS)}

    def vector(offsets: Sequence[int]) -> int:
        builder.StartVector(4, len(offsets), 4)
        for offset in reversed(offsets):
            builder.PrependUOffsetTRelative(offset)
        return int(builder.EndVector())

    def field(index: int, each: _Field) -> int:
        builder.StartObject(6)
        builder.PrependUint8Slot(0, each.kind, 0)
        builder.PrependUint8Slot(1, _OBJECT if each.length else 0, 0)
        builder.PrependInt32Slot(2, numbers.get(each.object, -1), -1)
        builder.PrependUint16Slot(3, each.length, 0)
        builder.PrependUint32Slot(4, _BYTES[each.kind], 4)
        builder.PrependUint32Slot(5, 4 if each.length else 1, 0)
        kind = builder.EndObject()
        builder.StartObject(14)
        builder.PrependUOffsetTRelativeSlot(0, texts[each.name], 0)
        builder.PrependUOffsetTRelativeSlot(1, kind, 0)
        builder.PrependUint16Slot(2, index, 0)
        builder.PrependUint16Slot(3, each.offset, 0)
        builder.PrependBoolSlot(11, bool(each.object), False)
        builder.PrependUint16Slot(12, each.padding, 0)
        return int(builder.EndObject())

    objects = []
    for item in _OBJECTS:
        made = {each.name: field(index, each) for index, each in enumerate(item.fields)}
        # Sorted by name, as flatc does and readers search.
        fields = vector([made[name] for name in sorted(made)])
        builder.StartObject(8)
        builder.PrependUOffsetTRelativeSlot(0, texts[item.name], 0)
        builder.PrependUOffsetTRelativeSlot(1, fields, 0)
        builder.PrependBoolSlot(2, item.bytes > 0, False)
        builder.PrependInt32Slot(3, item.alignment, 0)
        builder.PrependInt32Slot(4, item.bytes, 0)
        builder.PrependUOffsetTRelativeSlot(7, texts[item.file], 0)
        objects.append(builder.EndObject())
    listed, enums = vector(objects), vector([])
    builder.StartObject(8)
    builder.PrependUOffsetTRelativeSlot(0, listed, 0)
    builder.PrependUOffsetTRelativeSlot(1, enums, 0)
    builder.PrependUOffsetTRelativeSlot(2, empty, 0)
    builder.PrependUOffsetTRelativeSlot(3, empty, 0)
    builder.PrependUOffsetTRelativeSlot(4, objects[numbers[_ROOT]], 0)
    # `AdvancedArrayFeatures`.
    builder.PrependUint64Slot(6, 1, 0)
    builder.Finish(builder.EndObject(), file_identifier=b"BFBS")
    return bytes(builder.Output())


# The records.


def record(joints: np.ndarray[Any, Any], t_ns: int) -> bytes:
    """Return a `core.HandPoseRecord`.

    Args:
        joints: (26,) of `JOINT`.
        t_ns: when the hand was there; Isaac's own clock is the monotonic one, which a replay does not need.
    """
    builder = _builder()
    packed = joints.tobytes()

    def place(data: bytes, alignment: int) -> int:
        builder.Prep(alignment, len(data))
        builder.head -= len(data)
        builder.Bytes[builder.head : builder.head + len(data)] = data
        return int(builder.Offset())

    builder.StartObject(1)
    builder.PrependStructSlot(0, place(packed, 4), 0)
    hand = builder.EndObject()
    builder.StartObject(2)
    builder.PrependStructSlot(1, place(np.array([t_ns] * 3, "<i8").tobytes(), _ALIGNMENT), 0)
    builder.PrependUOffsetTRelativeSlot(0, hand, 0)
    builder.Finish(builder.EndObject())
    return bytes(builder.Output())


def records(motion: ExportedMotion) -> Iterator[tuple[int, bytes]]:
    """Yield time, nanoseconds, and record of every pose of a hand."""
    joints = np.zeros((len(motion.t_ns), len(JOINTS)), JOINT)
    joints["position"] = motion.positions
    joints["orientation"] = quaternion_from_rotation(motion.rotations)
    joints["is_valid"] = True
    joints["radius"] = motion.radii_m
    for t_ns, hand in zip(motion.t_ns.tolist(), joints, strict=True):
        yield t_ns, record(hand, t_ns)


def write_isaac(file: Path, found: Mapping[str, ExportedMotion]) -> int:
    """Write the hands of a recording; return how many poses.

    Raises:
        ConfigError: there is no hand, the file cannot be written, or a library is missing.
    """
    hands = {name.removeprefix("hand_"): motion for name, motion in found.items() if motion.is_hand}
    if not hands:
        raise ConfigError("--isaac: the recording holds no complete pose of a hand")
    described = schema()
    from mcap.writer import CompressionType, Writer  # noqa: PLC0415  # slow to load

    samples = sorted((t_ns, side, data) for side, motion in hands.items() for t_ns, data in records(motion))
    with replacing(file) as part, part.open("wb") as stream:
        # Isaac's reader knows no compression.
        writer = Writer(stream, compression=CompressionType.NONE)
        writer.start(library=f"rhot {__version__}")
        known = writer.register_schema(_ROOT, "flatbuffer", described)
        channels = {side: writer.register_channel(f"{BASE}/{side}_hand", "flatbuffer", known) for side in hands}
        for number, (t_ns, side, data) in enumerate(samples):
            writer.add_message(channels[side], t_ns, data, t_ns, number)
        writer.finish()  # type: ignore[no-untyped-call]
    return len(samples)
