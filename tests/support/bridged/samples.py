"""LSL and ROS 2 hand their samples to libraries, not to a socket: as packets for the readers, and back.

A packet is one line of JSON, then the bytes that go out.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from typing import Any

import numpy as np
from rosbags.typesys import Stores, get_typestore

from rhot_bridge.scene import Axes, Scene, Tracked
from rhot_bridge.targets.lsl import channels_of, joints_of, sample_of
from rhot_bridge.targets.ros2 import RosMessages


class LslPackets:
    """What LSL is handed, with the labels of its channels."""

    axes: Axes = "stage"
    triggers: Sequence[str] = ()

    def frame(self, scene: Scene, now_ns: int) -> list[bytes]:
        things: dict[str, Tracked] = {f"hand_{side}": hand for side, hand in scene.hands.items()}
        things |= {f"object_{name}": thing for name, thing in scene.objects.items()}
        things |= {f"foot_{side}": thing for side, thing in scene.feet.items()}
        things |= {} if scene.head is None else {"head": scene.head}
        packets = []
        for name, thing in things.items():
            channels = channels_of(name, joints_of(name, thing))
            head = {"name": name, "channels": [(channel.marker, channel.type) for channel in channels]}
            packets.append(json.dumps(head).encode() + b"\n" + sample_of(thing).tobytes())
        return packets


class Ros2Packets:
    """What ROS is handed, with its topics and types."""

    axes: Axes = "stage"
    triggers: Sequence[str] = ()

    def frame(self, scene: Scene, now_ns: int) -> list[bytes]:
        messages = RosMessages("stage").of(scene)
        return [json.dumps([each.topic, each.type]).encode() + b"\n" + each.payload for each in messages]


def lsl_samples(packets: list[bytes]) -> dict[str, dict[str, dict[str, float]]]:
    """Return the numbers by thing, joint and kind."""
    found: dict[str, dict[str, dict[str, float]]] = {}
    for packet in packets:
        head, _, data = packet.partition(b"\n")
        stated = json.loads(head)
        joints: dict[str, dict[str, float]] = found.setdefault(stated["name"], {})
        for (marker, kind), value in zip(stated["channels"], np.frombuffer(data, np.float32).tolist(), strict=True):
            joints.setdefault(marker, {})[kind] = value
    return found


def ros_messages(packets: list[bytes]) -> dict[str, Any]:
    """Return the messages by topic, decoded by rosbags; `test_ros2` has them decoded by ROS itself."""
    types = get_typestore(Stores.ROS2_JAZZY)
    found = {}
    for packet in packets:
        head, _, data = packet.partition(b"\n")
        topic, type_name = json.loads(head)
        found[topic] = types.deserialize_cdr(data, type_name)
    return found
