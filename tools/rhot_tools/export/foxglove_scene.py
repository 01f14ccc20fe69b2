"""Our messages as what Foxglove and Lichtblick draw: hands, points, objects and markers over the pictures.

Frames: `rig` as everywhere, `world` the same rotated by half a turn about x, so that what is up for cameras that look
down is up on the screen, and one frame for each camera and each pose.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Final

import numpy as np
from foxglove.messages import (
    CameraCalibration,
    CircleAnnotation,
    Color,
    CompressedImage,
    Duration,
    FrameTransform,
    FrameTransforms,
    ImageAnnotations,
    LinePrimitive,
    LinePrimitiveLineType,
    Point2,
    Point3,
    Pose,
    PoseInFrame,
    Quaternion,
    SceneEntity,
    SceneUpdate,
    SpherePrimitive,
    TextAnnotation,
    TextPrimitive,
    Timestamp,
    Vector3,
)

from rhot.anatomy.skeleton import PARENTS
from rhot.geometry.rotations import quaternion_from_rotation
from rhot.messages import BodyPose, FootPose, HandPose, MarkerFrame, Message, ObjectPose, PointSet, Truth
from rhot.rig import CameraCalibration as RigCamera

Shown = CameraCalibration | CompressedImage | FrameTransforms | ImageAnnotations | PoseInFrame | SceneUpdate
Topic = tuple[str, Shown]

WORLD: Final = "world"
MEASURED: Final = Color(r=0.16, g=0.62, b=0.56, a=1.0)
PREDICTED: Final = Color(r=0.91, g=0.55, b=0.16, a=1.0)
_TRUTH: Final = Color(r=0.6, g=0.6, b=0.6, a=0.4)
_CLEAR: Final = Color(r=0.0, g=0.0, b=0.0, a=0.0)
_SHADE: Final = Color(r=0.0, g=0.0, b=0.0, a=0.5)
_LIFETIME: Final = Duration(sec=0, nsec=500_000_000)
"""What is not seen again within this vanishes."""
_BONE_M: Final = 0.004
_POINT_M: Final = 0.010
_LABEL_PX: Final = 12.0
_IDENTITY: Final = [1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0]


def topics(key: str, message: Message) -> Iterator[Topic]:
    """Yield what a message looks like, by topic; nothing for messages that cannot be seen."""
    path = key.removeprefix("rhot")
    time = _time(message.t_ns)
    match message:
        case HandPose():
            yield path, _scene(time, message.frame, path, _hand_spheres(message), _hand_bones(message))
            wrist = message.joints.get("wrist")
            if wrist is not None:
                yield "/tf", _transform(time, message.frame, f"wrist_{message.side}", wrist.position, wrist.orientation)
        case PointSet():
            yield path, _points(time, path, message)
        case ObjectPose() | FootPose():
            pose = _pose(message.position, message.orientation)
            yield path, PoseInFrame(timestamp=time, frame_id=message.frame, pose=pose)
            name = path.strip("/").replace("/", "_")
            yield "/tf", _transform(time, message.frame, name, message.position, message.orientation)
        case BodyPose():
            color = _color(message.state)
            spheres = [_sphere(joint.position, 0.06, color) for joint in message.joints.values()]
            yield path, _scene(time, message.frame, path, spheres)
        case MarkerFrame():
            yield f"{path}/annotations", _annotations(time, message)
        case Truth():
            for side, joints in message.hands.items():
                lines = _bones({name: joint.position for name, joint in joints.items()}, _TRUTH)
                yield f"{path}/{side}", _scene(time, message.frame, f"{path}/{side}", [], lines)


def rig_topics(cameras: dict[str, RigCamera], t_ns: int) -> Iterator[Topic]:
    """Yield what stands still: which way is up, and where the cameras are and what their lenses do."""
    time = _time(t_ns)
    yield "/tf", _transform(time, WORLD, "rig", (0.0, 0.0, 0.0), (1.0, 0.0, 0.0, 0.0))
    for name, camera in cameras.items():
        T = np.array(camera.T_rig_camera)
        orientation = quaternion_from_rotation(T[:3, :3]).tolist()
        yield "/tf", _transform(time, "rig", name, T[:3, 3].tolist(), orientation)
        K = np.array(camera.K)
        yield (
            f"/camera/{name}/calibration",
            CameraCalibration(
                timestamp=time,
                frame_id=name,
                width=camera.width,
                height=camera.height,
                distortion_model="plumb_bob" if len(camera.distortion) <= 5 else "rational_polynomial",
                D=[*camera.distortion, *([0.0] * max(0, 5 - len(camera.distortion)))],
                K=K.ravel().tolist(),
                R=_IDENTITY,
                P=np.column_stack([K, np.zeros(3)]).ravel().tolist(),
            ),
        )


def picture_topic(camera: str, t_ns: int, data: bytes, coding: str) -> Topic:
    """Return a picture, coded as `jpeg` or `png`."""
    image = CompressedImage(timestamp=_time(t_ns), frame_id=camera, data=data, format=coding)
    return f"/camera/{camera}/image", image


def _scene(
    time: Timestamp,
    frame: str,
    name: str,
    spheres: Sequence[SpherePrimitive],
    lines: Sequence[LinePrimitive] = (),
    texts: Sequence[TextPrimitive] = (),
) -> SceneUpdate:
    entity = SceneEntity(
        timestamp=time,
        frame_id=frame,
        id=name,
        lifetime=_LIFETIME,
        frame_locked=True,
        spheres=list(spheres),
        lines=list(lines),
        texts=list(texts),
    )
    return SceneUpdate(entities=[entity])


def _hand_spheres(hand: HandPose) -> list[SpherePrimitive]:
    color = _color(hand.state)
    return [_sphere(joint.position, 2.0 * joint.radius, color) for joint in hand.joints.values()]


def _hand_bones(hand: HandPose) -> list[LinePrimitive]:
    return _bones({name: joint.position for name, joint in hand.joints.items()}, _color(hand.state))


def _bones(positions: dict[str, tuple[float, float, float]], color: Color) -> list[LinePrimitive]:
    ends = [
        Point3(x=positions[end][0], y=positions[end][1], z=positions[end][2])
        for joint, parent in PARENTS.items()
        if parent is not None and joint in positions and parent in positions
        for end in (parent, joint)
    ]
    if not ends:
        return []
    return [
        LinePrimitive(
            type=LinePrimitiveLineType.LineList,
            pose=_pose((0.0, 0.0, 0.0)),
            thickness=_BONE_M,
            points=ends,
            color=color,
        )
    ]


def _points(time: Timestamp, name: str, points: PointSet) -> SceneUpdate:
    spheres = [_sphere(point.position, _POINT_M, _color(point.state)) for point in points.points.values()]
    texts = [
        TextPrimitive(
            pose=_pose(point.position),
            billboard=True,
            font_size=_LABEL_PX,
            scale_invariant=True,
            color=_color(point.state),
            text=marker,
        )
        for marker, point in points.points.items()
    ]
    return _scene(time, points.frame, name, spheres, texts=texts)


def _annotations(time: Timestamp, frame: MarkerFrame) -> ImageAnnotations:
    circles, texts = [], []
    for name, marker in frame.markers.items():
        # Our pixel centres are on integers, theirs on halves.
        u, v = marker.u + 0.5, marker.v + 0.5
        diameter = max(4.0, 2.0 * float(np.sqrt(marker.area / np.pi)))
        circles.append(
            CircleAnnotation(
                timestamp=time,
                position=Point2(x=u, y=v),
                diameter=diameter,
                thickness=1.0,
                fill_color=_CLEAR,
                outline_color=MEASURED,
            )
        )
        texts.append(
            TextAnnotation(
                timestamp=time,
                position=Point2(x=u + 0.5 * diameter, y=v),
                text=f"{name} {marker.score:.2f}",
                font_size=_LABEL_PX,
                text_color=MEASURED,
                background_color=_SHADE,
            )
        )
    return ImageAnnotations(circles=circles, texts=texts)


def _sphere(position: Sequence[float], diameter_m: float, color: Color) -> SpherePrimitive:
    size = Vector3(x=diameter_m, y=diameter_m, z=diameter_m)
    return SpherePrimitive(pose=_pose(position), size=size, color=color)


def _transform(
    time: Timestamp, parent: str, child: str, position: Sequence[float], orientation: Sequence[float]
) -> FrameTransforms:
    transform = FrameTransform(
        timestamp=time,
        parent_frame_id=parent,
        child_frame_id=child,
        translation=_vector(position),
        rotation=_quaternion(orientation),
    )
    return FrameTransforms(transforms=[transform])


def _color(state: str) -> Color:
    return MEASURED if state == "measured" else PREDICTED


def _time(t_ns: int) -> Timestamp:
    return Timestamp(sec=t_ns // 1_000_000_000, nsec=t_ns % 1_000_000_000)


def _pose(position: Sequence[float], orientation_xyzw: Sequence[float] = (0.0, 0.0, 0.0, 1.0)) -> Pose:
    return Pose(position=_vector(position), orientation=_quaternion(orientation_xyzw))


def _vector(values: Sequence[float]) -> Vector3:
    x, y, z = values
    return Vector3(x=x, y=y, z=z)


def _quaternion(xyzw: Sequence[float]) -> Quaternion:
    x, y, z, w = xyzw
    return Quaternion(x=x, y=y, z=z, w=w)
