"""ROS 2: poses as ROS messages over Zenoh, as its middleware rmw_zenoh sends them; ROS need not be installed.

| topic | message | of |
|---|---|---|
| `/rhot/hand_right`, `/rhot/hand_left` | geometry_msgs/PoseArray | the 26 joints in OpenXR's order |
| `/rhot/body` | geometry_msgs/PoseArray | the known joints of the body; `/tf` names them |
| `/rhot/object_cup`, `/rhot/head`, `/rhot/foot_left`, … | geometry_msgs/PoseStamped | one rigid body |
| `/tf` | tf2_msgs/TFMessage | `rhot_floor` to `hand_right_wrist`, `object_cup`, `body_hips`, … |

The stamp is the sample's time on the rig clock, which counts from 1970 like ROS time. Poses that are no longer tracked
are not sent, and no sample is sent twice.

The frame `rhot_floor` is the stage in ROS's axes (REP 103: x forward, y left, z up, origin on the floor):

    p_ros = C · p_stage = (−z, −x, y),   R_ros = C · R_stage

so a joint keeps OpenXR's axes. With `axes = "rig"` the frame is `rhot_rig`, the first camera's optical frame.
"""

from __future__ import annotations

import os
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
from rosbags.typesys import Stores, get_typestore

from rhot.anatomy.hand import WRIST
from rhot.arrays import FloatArray
from rhot.errors import ConfigError
from rhot.geometry.rotations import product_matrix, quaternion_from_rotation
from rhot.rig import BridgeConfig
from rhot_bridge.links.rmw_zenoh import RmwZenohLink
from rhot_bridge.scene import Axes, Body, Poses, Scene, Thing

PORT: Final = 7447
"""Default port of rmw_zenoh's router, and of ours."""
POSE_ARRAY: Final = "geometry_msgs/msg/PoseArray"
POSE_STAMPED: Final = "geometry_msgs/msg/PoseStamped"
TF_MESSAGE: Final = "tf2_msgs/msg/TFMessage"
R_ROS_STAGE: FloatArray = np.array([[0.0, 0.0, -1.0], [-1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])
R_ROS_STAGE.setflags(write=False)

# Definitions and type hashes of these messages have been the same from Humble to Kilted.
_TYPES: Final = get_typestore(Stores.ROS2_KILTED)
_MULTIPLY: Final = product_matrix(*quaternion_from_rotation(R_ROS_STAGE).tolist())


@dataclass(frozen=True, slots=True)
class RosMessage:
    """An encoded message: its topic, its type (`geometry_msgs/msg/PoseArray`) and its payload in CDR."""

    topic: str
    type: str
    payload: bytes


def type_hash(type_name: str) -> str:
    """Return the hash of a message's definition, such as `RIHS01_af0c…` (REP 2011)."""
    return _TYPES.hash_rihs01(type_name)


class RosMessages:
    """Converts scenes to messages; keeps only the times of the last samples.

    Args:
        axes: of the scenes, `stage` or `rig`.
    """

    def __init__(self, axes: Axes) -> None:
        self.frame_id = "rhot_floor" if axes == "stage" else "rhot_rig"
        self._turn = axes == "stage"
        self._sent_ns: dict[str, int] = {}

    def of(self, scene: Scene) -> list[RosMessage]:
        """Return the messages of all new samples in a scene."""
        found: list[RosMessage] = []
        transforms: list[Any] = []
        before, self._sent_ns = self._sent_ns, {name: poses.t_ns for name, poses in _named(scene)}
        for name, poses in _named(scene):
            # Compared for equality, because the rig clock may be set back.
            if poses.state == "kept" or poses.t_ns == before.get(name):
                continue
            header = self._header(poses.t_ns)
            positions, orientations = self._rotated(poses)
            ros = [_pose(*each) for each in zip(positions.tolist(), orientations.tolist(), strict=True)]
            if isinstance(poses, Thing):
                found.append(_message(f"/rhot/{name}", POSE_STAMPED, header=header, pose=ros[0]))
            else:
                found.append(_message(f"/rhot/{name}", POSE_ARRAY, header=header, poses=ros))
            transforms += self._transforms(name, poses, header, positions, orientations)
        if transforms:
            found.append(_message("/tf", TF_MESSAGE, transforms=transforms))
        return found

    def _header(self, t_ns: int) -> Any:
        seconds, nanoseconds = divmod(t_ns, 1_000_000_000)
        stamp = _make("builtin_interfaces/msg/Time", sec=seconds, nanosec=nanoseconds)
        return _make("std_msgs/msg/Header", stamp=stamp, frame_id=self.frame_id)

    def _rotated(self, poses: Poses) -> tuple[FloatArray, FloatArray]:
        if not self._turn:
            return poses.positions, poses.orientations
        return poses.positions @ R_ROS_STAGE.T, poses.orientations @ _MULTIPLY.T

    def _transforms(
        self, name: str, poses: Poses, header: Any, positions: FloatArray, orientations: FloatArray
    ) -> Iterator[Any]:
        if isinstance(poses, Body):
            rows = [(f"{name}_{joint}", row) for row, joint in enumerate(poses.names)]
        else:
            # A hand's other joints are only in its own topic, because listeners of /tf keep ten seconds of each frame.
            rows = [(name, 0) if isinstance(poses, Thing) else (f"{name}_wrist", WRIST)]
        for child, row in rows:
            x, y, z = positions[row].tolist()
            qx, qy, qz, qw = orientations[row].tolist()
            yield _make(
                "geometry_msgs/msg/TransformStamped",
                header=header,
                child_frame_id=child,
                transform=_make(
                    "geometry_msgs/msg/Transform",
                    translation=_make("geometry_msgs/msg/Vector3", x=x, y=y, z=z),
                    rotation=_make("geometry_msgs/msg/Quaternion", x=qx, y=qy, z=qz, w=qw),
                ),
            )


class Ros2Output:
    """Sends ROS messages over rmw_zenoh's link."""

    triggers: Sequence[str] = ("hand", "body", "foot", "object", "head")

    def __init__(self, config: BridgeConfig) -> None:
        """Create the link.

        Raises:
            ConfigError: the axes are Unity's, or `ROS_DOMAIN_ID` is not a number.
        """
        if config.axes == "unity":
            raise ConfigError('bridge ros2: axes = "unity" is not ROS\'s; use stage or rig')
        self.axes: Axes = config.axes
        self._messages = RosMessages(config.axes)
        self._link = RmwZenohLink(config.host, config.port or PORT, ros_domain(), type_hash)
        self.open, self.close, self.wanted = self._link.open, self._link.close, self._link.wanted

    @property
    def where(self) -> str:
        """The link's receiver, for people."""
        return self._link.where

    @property
    def problem(self) -> str:
        """The link's problem; empty when there is none."""
        return self._link.problem

    def send(self, scene: Scene, now_ns: int) -> tuple[int, int]:
        """Send the new samples of a scene; return how many messages were sent and how many lost."""
        went = [self._link.put(each.topic, each.type, each.payload) for each in self._messages.of(scene)]
        return went.count(True), went.count(False)


def make_output(config: BridgeConfig) -> Ros2Output:
    """Return the output that a configuration asks for."""
    return Ros2Output(config)


def ros_domain() -> int:
    """Return the ROS domain: the environment variable `ROS_DOMAIN_ID`, else 0.

    Raises:
        ConfigError: it is not a number.
    """
    text = os.environ.get("ROS_DOMAIN_ID", "").strip() or "0"
    if not text.isdecimal():
        raise ConfigError(f"ROS_DOMAIN_ID = {text[:20]!r} is not a number, such as 0")
    return int(text)


def _named(scene: Scene) -> Iterator[tuple[str, Poses]]:
    yield from ((f"hand_{side}", hand) for side, hand in scene.hands.items())
    yield from ((f"object_{name.replace('-', '_').replace('.', '_')}", thing) for name, thing in scene.objects.items())
    yield from ((f"foot_{side}", thing) for side, thing in scene.feet.items())
    if scene.head is not None:
        yield "head", scene.head
    if scene.body is not None:
        yield "body", scene.body


def _make(type_name: str, **fields: Any) -> Any:
    return _TYPES.types[type_name](**fields)


def _message(topic: str, type_name: str, **fields: Any) -> RosMessage:
    return RosMessage(topic, type_name, bytes(_TYPES.serialize_cdr(_make(type_name, **fields), type_name)))


def _pose(position: Sequence[float], xyzw: Sequence[float]) -> Any:
    x, y, z = position
    qx, qy, qz, qw = xyzw
    return _make(
        "geometry_msgs/msg/Pose",
        position=_make("geometry_msgs/msg/Point", x=x, y=y, z=z),
        orientation=_make("geometry_msgs/msg/Quaternion", x=qx, y=qy, z=qz, w=qw),
    )
