"""Over all targets: a left hand is a left hand, up is up, metres are metres.

Four known poses of a person above a floor go through the bus's messages, the floor, and each target's packets; a reader
written from the other program's specification puts them back above the floor.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import cache

import numpy as np
import pytest
from bridged import poses as bridge_poses
from bridged.readers import READERS, Seen
from bridged.samples import LslPackets, Ros2Packets

from rhot.anatomy.skeleton import JOINTS
from rhot.geometry.rotations import inverse
from rhot.messages import Side
from rhot_bridge.axes import Converter
from rhot_bridge.scene import Scene, tracked
from rhot_bridge.targets import TARGETS, Target
from rhot_bridge.targets.json_text import JsonTarget
from rhot_bridge.targets.vmc import VmcTarget
from rhot_bridge.targets.vmt import VmtTarget
from rhot_bridge.targets.vrchat import VrChatTarget

SIDES: tuple[Side, Side] = ("left", "right")
MAKERS: dict[str, Callable[[], Target]] = {
    "json": lambda: JsonTarget("stage"),
    "json in Unity's axes": lambda: JsonTarget("unity"),
    "lsl": LslPackets,
    "ros2": Ros2Packets,
    "vmc": lambda: VmcTarget("arms", 1.70),
    "vmt": VmtTarget,
    "vrchat": VrChatTarget,
}
ALL = [*MAKERS, "lsl"]
WITH_HANDS = [name for name in ALL if name != "vrchat"]
FINGERS = ("index", "middle", "ring", "little")
EXTENDED = {"flat": FINGERS, "fist": (), "thumb up": (), "pointing": ("index",)}


def rig_scene(pose: str) -> Scene:
    """What the feed makes of a person's messages, rig axes."""
    T = Converter("stage", inverse(bridge_poses.T_RIG_STAGE))
    person = T.scene(bridge_poses.scene(pose))
    hands = {side: tracked(bridge_poses.hand_message(pose, side, 10**18)) for side in SIDES}
    return Scene("rig", 10**18, hands, person.objects, person.head, person.feet)  # type: ignore[arg-type]


@cache
def seen(name: str, pose: str) -> Seen:
    if name == "lsl":
        return seen_by_lsl(Converter("stage", bridge_poses.T_RIG_STAGE).scene(rig_scene(pose)))
    target = MAKERS[name]()
    scene = Converter(target.axes, bridge_poses.T_RIG_STAGE).scene(rig_scene(pose))
    return READERS[name.split(maxsplit=1)[0]](target.frame(scene, 0))


def seen_by_lsl(scene: Scene) -> Seen:
    """A stream's sample by its channels' descriptions, as a lab's script reads it."""
    lsl = pytest.importorskip("rhot_bridge.targets.lsl", reason="pip install 'rhot[lsl]'")
    found = Seen()
    things = {f"hand_{side}": (hand, JOINTS) for side, hand in scene.hands.items()}
    things |= {name: (thing, (name,)) for name, thing in scene.objects.items()}  # type: ignore[misc]
    for name, (thing, joints) in things.items():
        sample = dict(
            zip(((c.marker, c.type) for c in lsl.channels_of(name, joints)), lsl.sample_of(thing), strict=True)
        )
        for joint in joints:
            position = np.array([sample[joint, f"Position{axis}"] for axis in "XYZ"], dtype=np.float64)
            found.positions[f"{name[5:]} {joint}" if name.startswith("hand_") else name] = position
    return found


def test_every_target_is_read() -> None:
    """ROS 2 is read by rclpy, and OpenXR's memory by its layer, in tests of their own."""
    assert set(TARGETS) - {"ros2", "openxr"} <= {name.split(maxsplit=1)[0] for name in ALL}


@pytest.mark.parametrize("pose", bridge_poses.POSES)
@pytest.mark.parametrize("target", WITH_HANDS)
def test_wrists_are_where_they_are(target: str, pose: str) -> None:
    for side, x in (("left", -0.2), ("right", 0.2)):
        assert seen(target, pose).hand(side)["wrist"] == pytest.approx([x, 1.1, -0.4], abs=1e-3)


@pytest.mark.parametrize("pose", bridge_poses.POSES)
@pytest.mark.parametrize("target", WITH_HANDS)
def test_all_joints_are_where_ours_are(target: str, pose: str) -> None:
    for side in SIDES:
        ours = bridge_poses.hand(pose, side).positions
        joints = seen(target, pose).hand(side)
        compared = [name for name in joints if "_" in name]
        assert len(compared) >= 15
        for name in compared:
            assert np.linalg.norm(joints[name] - ours[bridge_poses.row(name)]) < 1e-3, (side, name)


@pytest.mark.parametrize("pose", bridge_poses.POSES)
@pytest.mark.parametrize("target", WITH_HANDS)
def test_fingers_say_what_the_hand_does(target: str, pose: str) -> None:
    for side, towards_other in (("left", 1.0), ("right", -1.0)):
        hand = seen(target, pose).hand(side)
        for finger in FINGERS:
            reach = np.linalg.norm(hand[f"{finger}_distal"] - hand["wrist"])
            knuckle = np.linalg.norm(hand[f"{finger}_proximal"] - hand["wrist"])
            assert (reach > knuckle + 0.02) == (finger in EXTENDED[pose]), (side, finger)
        thumb = hand["thumb_distal"] - hand["wrist"]
        if pose == "thumb up":
            assert thumb[1] > 0.05
            assert hand["index_proximal"][1] > hand["little_proximal"][1] + 0.03
        else:
            # Palms down: thumbs and forefingers lie on the sides of the other hand, and fingers curl downwards.
            assert towards_other * (hand["index_proximal"] - hand["little_proximal"])[0] > 0.03
            assert pose != "flat" or towards_other * thumb[0] > 0.02
            assert all(hand[f"{finger}_distal"][1] < 1.13 for finger in FINGERS)
        if pose == "pointing":
            assert hand["index_distal"][2] < -0.4 - 0.12
        if pose == "fist":
            assert all(hand[f"{finger}_distal"][1] < hand[f"{finger}_proximal"][1] - 0.01 for finger in FINGERS)


@pytest.mark.parametrize("target", ALL)
def test_up_is_up_and_metres_are_metres(target: str) -> None:
    positions = seen(target, "flat").positions
    known = {
        "cube": (0.0, 0.75, -0.6),
        "left foot": (-0.1, 0.05, 0.0),
        "right foot": (0.1, 0.05, 0.0),
    }
    if target not in ("vmc", "lsl"):
        known["head"] = (0.0, 1.6, -0.1)
    checked = [name for name in known if name in positions]
    assert checked
    for name in checked:
        assert positions[name] == pytest.approx(known[name], abs=1e-4)
    if target == "vmc":
        # The head bone is the pivot below and behind the eyes.
        assert positions["head"] == pytest.approx([0.0, 1.6 - 0.102, -0.1 + 0.085], abs=1e-3)
        assert positions["hips"][1] == pytest.approx(0.91, abs=0.02)
