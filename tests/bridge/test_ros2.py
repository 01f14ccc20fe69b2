"""ROS 2: keys, tokens and attachments as rmw_zenoh has them, and messages that ROS's own rclpy decodes."""

from __future__ import annotations

import asyncio
import dataclasses
import json
import os
import struct
import subprocess

import numpy as np
import pytest
import zenoh
from bridged import poses as bridge_poses
from bus_watch import PATIENCE_S
from exported import person
from exported.foreign_programs import ros_python
from zenoh.ext import Int64, z_serialize

from rhot.bus import Bus
from rhot.bus.zenoh_config import session_config
from rhot.errors import ConfigError, DeviceError
from rhot.geometry.rotations import rotation_from_quaternion
from rhot.rig import BridgeConfig, BusConfig
from rhot_bridge.links import rmw_zenoh
from rhot_bridge.links.rmw_zenoh import attachment, node_token, publisher_token, topic_key
from rhot_bridge.scene import Body, Scene, tracked
from rhot_bridge.targets import ros2

POSE_ARRAY_HASH = "RIHS01_af0cc36d190e104d546d168d6b39df04fa4b4ccecf59cb4c9ed328d3d5004aa0"
"""Of geometry_msgs/msg/PoseArray, as rclpy of Kilted states it; see `test_rclpy_decodes_and_agrees_on_the_type`."""


def scene() -> Scene:
    """A person in stage axes, with legs."""
    whole = bridge_poses.scene("fist")
    body = tracked(person.body_message(10**18, np.eye(4)))
    return Scene("stage", whole.t_ns, whole.hands, whole.objects, whole.head, whole.feet, body)  # type: ignore[arg-type]


def test_keys_tokens_and_attachments_are_those_of_rmw_zenoh() -> None:
    """The examples of its design, with our names in them."""
    assert ros2.type_hash(ros2.POSE_ARRAY) == POSE_ARRAY_HASH
    assert (
        topic_key(7, "/rhot/hand_left", ros2.POSE_ARRAY, POSE_ARRAY_HASH)
        == f"7/rhot/hand_left/geometry_msgs::msg::dds_::PoseArray_/{POSE_ARRAY_HASH}"
    )
    assert node_token(7, "aac3178e") == "@ros2_lv/7/aac3178e/0/0/NN/%/%/rhot"
    assert publisher_token(7, "aac3178e", 3, "/rhot/hand_left", ros2.POSE_ARRAY, POSE_ARRAY_HASH) == (
        "@ros2_lv/7/aac3178e/0/3/MP/%/%/rhot/%rhot%hand_left/geometry_msgs::msg::dds_::PoseArray_/"
        f"{POSE_ARRAY_HASH}/::,10:,:,:,,"
    )
    made = attachment(2, 10**18, bytes(range(16)))
    assert len(made) == 33
    assert struct.unpack_from("<qq", made) == (2, 10**18)
    assert made[16:] == bytes([16, *range(16)])
    assert made == bytes(z_serialize((Int64(2), Int64(10**18), bytes(range(16))))), "as Zenoh itself writes it"


def test_nothing_goes_out_twice_or_after_it_is_lost() -> None:
    messages = ros2.RosMessages("stage")
    assert {each.topic for each in messages.of(scene())} == {
        *("/rhot/hand_left", "/rhot/hand_right", "/rhot/object_cube", "/rhot/head", "/rhot/foot_left"),
        *("/rhot/foot_right", "/rhot/body", "/tf"),
    }
    assert messages.of(scene()) == []


def test_poses_go_on_after_the_rig_clock_was_set_back() -> None:
    messages = ros2.RosMessages("stage")
    now, before = scene(), bridge_poses.scene("fist")
    head = dataclasses.replace(now.head, t_ns=before.t_ns - 3_600_000_000_000)  # type: ignore[type-var]
    assert messages.of(now)
    assert [each.topic for each in messages.of(dataclasses.replace(before, head=head))] == ["/rhot/head", "/tf"]


def test_a_topic_has_one_type_however_little_is_known_of_a_body() -> None:
    body = Body(10**18, "measured", 1.0, np.zeros((1, 3)), np.array([[0.0, 0.0, 0.0, 1.0]]), ("hips",))
    sent = ros2.RosMessages("stage").of(Scene("stage", body.t_ns, body=body))
    assert [(each.topic, each.type) for each in sent] == [
        ("/rhot/body", ros2.POSE_ARRAY),
        ("/tf", ros2.TF_MESSAGE),
    ]


def test_what_ros_does_not_know_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(ConfigError, match="unity"):
        ros2.make_output(BridgeConfig(target="ros2", axes="unity"))
    monkeypatch.setenv("ROS_DOMAIN_ID", "red")
    with pytest.raises(ConfigError, match="ROS_DOMAIN_ID"):
        ros2.make_output(BridgeConfig(target="ros2"))


async def test_no_router_is_told(free_port: int) -> None:
    output = ros2.make_output(BridgeConfig(target="ros2", port=free_port))
    with pytest.raises(DeviceError, match="rmw_zenohd"):
        await output.open()


async def test_a_router_that_refuses_the_node_leaves_no_session(
    free_port: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    def refuse(*_: object) -> str:
        raise zenoh.ZError("not authorised")

    monkeypatch.setattr("rhot_bridge.links.rmw_zenoh.node_token", refuse)
    output = ros2.make_output(BridgeConfig(target="ros2", port=free_port))
    async with await Bus.open(BusConfig(mode="router", connect=(), listen=(f"tcp/127.0.0.1:{free_port}",))):
        with pytest.raises(DeviceError, match="not authorised"):
            await output.open()
        assert not output.wanted(0)


async def test_a_router_carries_messages_tokens_and_attachments(
    free_port: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("ROS_DOMAIN_ID", "42")
    endpoint = f"tcp/127.0.0.1:{free_port}"
    output = ros2.make_output(BridgeConfig(target="ros2", port=free_port))
    heard: list[zenoh.Sample] = []
    async with await Bus.open(BusConfig(mode="router", connect=(), listen=(endpoint,))):
        listener = await asyncio.to_thread(zenoh.open, session_config(BusConfig(connect=(endpoint,))))
        try:
            listener.declare_subscriber("42/**", zenoh.handlers.Callback(heard.append, indirect=False))
            await output.open()
            async with asyncio.timeout(PATIENCE_S):
                while len({str(sample.key_expr) for sample in heard}) < 8:
                    assert output.wanted(0)
                    fresh = ros2.RosMessages("stage")
                    monkeypatch.setattr(output, "_messages", fresh)
                    sent, lost = output.send(scene(), 0)
                    assert lost == 0
                    assert sent <= 8
                    await asyncio.sleep(0.02)
            replies = listener.liveliness().get("@ros2_lv/42/**", timeout=5.0)
            tokens = [str(reply.ok.key_expr) for reply in replies if reply.ok is not None]
        finally:
            await output.close()
            await asyncio.to_thread(listener.close)
    assert sum("/NN/%/%/rhot" in token for token in tokens) == 1
    assert len({token.split("/")[4] for token in tokens}) == len(tokens) == 9
    for sample in heard:
        domain, *topic, type_name, type_hash = str(sample.key_expr).split("/")
        token = f"/%{'%'.join(topic)}/{type_name}/{type_hash}/::,10:,:,:,,"
        assert domain == "42"
        assert sum(each.endswith(token) for each in tokens) == 1, "each topic has its token"
        assert sample.attachment is not None
        sequence, t_ns, size = struct.unpack_from("<qqB", sample.attachment.to_bytes())
        assert (size, len(sample.attachment.to_bytes())) == (16, 33)
        assert sequence >= 1
        assert abs(t_ns - 1e9 * (await asyncio.to_thread(_now_s))) < 60e9


async def test_topics_that_are_silent_make_room_for_others(free_port: int, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(rmw_zenoh, "MOST_TOPICS", 2)
    monkeypatch.setattr("rhot_bridge.output.SILENT_NS", 200_000_000)
    link = rmw_zenoh.RmwZenohLink("127.0.0.1", free_port, 0, ros2.type_hash)

    async def goes_out(topic: str) -> None:
        async with asyncio.timeout(PATIENCE_S):
            while not link.put(topic, ros2.POSE_STAMPED, b""):
                await asyncio.sleep(0.01)

    async with await Bus.open(BusConfig(mode="router", connect=(), listen=(f"tcp/127.0.0.1:{free_port}",))):
        await link.open()
        try:
            for topic in ("/a", "/b", "/c", "/d", "/a"):
                await goes_out(topic)
            assert list(link._publishers) == ["/d", "/a"]
        finally:
            await link.close()


def _now_s() -> float:
    import time

    return time.time()


_DECODE = """
import json, sys
import rclpy
from rclpy.serialization import deserialize_message
from geometry_msgs.msg import PoseArray, PoseStamped
found = {}
for line in sys.stdin:
    topic, type_name, payload = line.split()
    kind = {"PoseArray": PoseArray, "PoseStamped": PoseStamped}[type_name.rpartition("/")[2]]
    message = deserialize_message(bytes.fromhex(payload), kind)
    poses = message.poses if kind is PoseArray else [message.pose]
    found[topic] = {
        "frame": message.header.frame_id,
        "t": [message.header.stamp.sec, message.header.stamp.nanosec],
        "p": [[p.position.x, p.position.y, p.position.z] for p in poses],
        "q": [[p.orientation.x, p.orientation.y, p.orientation.z, p.orientation.w] for p in poses],
    }
rclpy.init()
node = rclpy.create_node("test")
publishers = [node.create_publisher(PoseArray, "a", 1), node.create_publisher(PoseStamped, "b", 1)]
hashes = [str(node.get_publishers_info_by_topic(topic)[0].topic_type_hash) for topic in ("/a", "/b")]
print(json.dumps({"found": found, "hashes": hashes}))
rclpy.shutdown()
"""


@pytest.mark.integration
def test_rclpy_decodes_and_agrees_on_the_type() -> None:
    python = ros_python()
    sent = [each for each in ros2.RosMessages("stage").of(scene()) if each.topic != "/tf"]
    lines = "".join(f"{each.topic} {each.type} {each.payload.hex()}\n" for each in sent)
    environment = {**os.environ, "ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST", "ROS_DOMAIN_ID": "87"}
    done = subprocess.run(
        [str(python), "-c", _DECODE],
        input=lines,
        capture_output=True,
        text=True,
        timeout=120,
        check=False,
        env=environment,
    )
    assert done.returncode == 0, done.stderr
    answer = json.loads(done.stdout.strip().splitlines()[-1])
    hashes = [ros2.type_hash(ros2.POSE_ARRAY), ros2.type_hash(ros2.POSE_STAMPED)]
    assert [text.lower() for text in answer["hashes"]] == [text.lower() for text in hashes]
    hand = answer["found"]["/rhot/hand_left"]
    assert (hand["frame"], hand["t"]) == ("rhot_floor", [10**9, 0])
    truth = bridge_poses.hand("fist", "left")
    x, y, z = truth.positions.T
    np.testing.assert_allclose(hand["p"], np.column_stack([-z, -x, y]), atol=1e-12)
    turned = ros2.R_ROS_STAGE @ rotation_from_quaternion(truth.orientations)
    np.testing.assert_allclose(rotation_from_quaternion(np.array(hand["q"])), turned, atol=1e-9)
    assert answer["found"]["/rhot/object_cube"]["p"] == [[0.6, -0.0, 0.75]]
    assert len(answer["found"]["/rhot/body"]["p"]) == len(person.JOINTS)
