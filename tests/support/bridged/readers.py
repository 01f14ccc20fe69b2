"""What other programs make of a bridge's packets, written from their specifications and with parsers that are not ours.

Each reader returns what it saw in stage axes (metres, y up, −z forward, x right), joints by OpenXR's names.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from typing import Any, Final

import numpy as np
from bridged.samples import lsl_samples, ros_messages
from pythonosc.osc_bundle import OscBundle
from pythonosc.osc_message import OscMessage

from rhot.anatomy.skeleton import FINGERS, JOINTS
from rhot.arrays import FloatArray

MIRROR: Final = np.diag([1.0, 1.0, -1.0])


@dataclass
class Seen:
    """Positions and rotations by `<side> <joint>`, or by the name of a thing, in stage axes."""

    positions: dict[str, FloatArray] = field(default_factory=dict)
    rotations: dict[str, FloatArray] = field(default_factory=dict)

    def hand(self, side: str) -> dict[str, FloatArray]:
        """Joints of a hand by name."""
        return {name.partition(" ")[2]: place for name, place in self.positions.items() if name.startswith(f"{side} ")}


def messages(packets: list[bytes]) -> Iterator[tuple[str, list[Any]]]:
    """Addresses and arguments of OSC packets, by python-osc; each has to fit into a network frame."""
    for packet in packets:
        assert len(packet) <= 1472
        assert OscBundle.dgram_is_bundle(packet)
        for part in OscBundle(packet):
            assert isinstance(part, OscMessage)
            yield part.address, list(part.params)


def matrix(xyzw: Any) -> FloatArray:
    """Rotation of a quaternion, by the textbook."""
    x, y, z, w = np.asarray(xyzw, dtype=np.float64) / np.linalg.norm(xyzw)
    v, s = np.array([x, y, z]), float(w)
    cross = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    R: FloatArray = (s * s - v @ v) * np.eye(3) + 2.0 * np.outer(v, v) + 2.0 * s * cross
    return R


def read_json(packets: list[bytes]) -> Seen:
    """As a browser would."""
    (packet,) = packets
    frame = json.loads(packet)
    flip = MIRROR if frame["axes"] == "unity" else np.eye(3)
    seen = Seen()
    for hand in frame["hands"]:
        positions = np.array(hand["positions"]).reshape(-1, 3)
        orientations = np.array(hand["orientations"]).reshape(-1, 4)
        for name, position, orientation in zip(JOINTS, positions, orientations, strict=True):
            seen.positions[f"{hand['side']} {name}"] = flip @ position
            seen.rotations[f"{hand['side']} {name}"] = flip @ matrix(orientation) @ flip
    things = {thing["id"]: thing for thing in frame["objects"]}
    things |= {f"{foot['side']} foot": foot for foot in frame["feet"]} | {"head": frame["head"]}
    for name, thing in things.items():
        seen.positions[name] = flip @ np.array(thing["position"])
    return seen


def read_vrchat(packets: list[bytes]) -> Seen:
    """As VRChat: numbered trackers in Unity's axes, Euler angles z, x, y."""
    names = {"1": "hips", "2": "left foot", "3": "right foot", "4": "left knee", "5": "right knee", "head": "head"}
    seen = Seen()
    for address, values in messages(packets):
        _, _, _, tracker, kind = address.split("/")
        assert all(isinstance(value, float) for value in values)
        if kind == "position":
            seen.positions[names[tracker]] = MIRROR @ np.array(values)
            continue
        x, y, z = np.radians(values)
        cx, sx, cy, sy, cz, sz = np.cos(x), np.sin(x), np.cos(y), np.sin(y), np.cos(z), np.sin(z)
        about_z = np.array([[cz, -sz, 0.0], [sz, cz, 0.0], [0.0, 0.0, 1.0]])
        about_x = np.array([[1.0, 0.0, 0.0], [0.0, cx, -sx], [0.0, sx, cx]])
        about_y = np.array([[cy, 0.0, sy], [0.0, 1.0, 0.0], [-sy, 0.0, cy]])
        seen.rotations[names[tracker]] = MIRROR @ about_y @ about_x @ about_z @ MIRROR
    return seen


_VMC_PARENT: Final = {
    "Hips": "",
    "Spine": "Hips",
    "Chest": "Spine",
    "Neck": "Chest",
    "Head": "Neck",
    **{
        f"{side}{bone}": parent
        for side in ("Left", "Right")
        for bone, parent in (
            ("UpperArm", "Chest"),
            ("LowerArm", f"{side}UpperArm"),
            ("Hand", f"{side}LowerArm"),
            ("UpperLeg", "Hips"),
            ("LowerLeg", f"{side}UpperLeg"),
            ("Foot", f"{side}LowerLeg"),
            *(
                (f"{finger}{segment}", f"{side}{finger}{before}" if before else f"{side}Hand")
                for finger in ("Thumb", "Index", "Middle", "Ring", "Little")
                for segment, before in (("Proximal", ""), ("Intermediate", "Proximal"), ("Distal", "Intermediate"))
            ),
        )
    },
}
_THUMB_JOINTS: Final = {"Proximal": "metacarpal", "Intermediate": "proximal", "Distal": "distal"}


def read_vmc(packets: list[bytes]) -> Seen:
    """As a VMC receiver that applies positions, too: forward kinematics over HumanBodyBones, Unity's axes.

    Without a chest, arms hang on the neck's end, whose place is the head bone's.
    """
    bones: dict[str, list[float]] = {}
    seen = Seen()
    for address, values in messages(packets):
        if address == "/VMC/Ext/Bone/Pos":
            bones[values[0]] = values[1:]
        elif address == "/VMC/Ext/Tra/Pos":
            seen.positions[values[0]] = MIRROR @ np.array(values[1:4])
    placed: dict[str, tuple[FloatArray, FloatArray]] = {"": (np.zeros(3), np.eye(3))}
    for name, usual in _VMC_PARENT.items():
        # A bone whose parent is not sent hangs on the nearest one that is.
        parent = usual
        while parent not in placed and parent in _VMC_PARENT:
            parent = _VMC_PARENT[parent]
        if name in bones and parent in placed:
            p, R = placed[parent]
            if name.endswith("UpperArm") and "Chest" not in bones:
                p = placed["Head"][0]
            placed[name] = p + R @ np.array(bones[name][:3]), R @ matrix(bones[name][3:])
    for name, (p, R) in placed.items():
        side = next((each for each in ("Left", "Right") if name.startswith(each)), "")
        bone = name.removeprefix(side)
        joint = bone.lower()
        for finger in FINGERS:
            if bone.startswith(finger.capitalize()):
                segment = bone.removeprefix(finger.capitalize())
                joint = f"{finger}_{_THUMB_JOINTS[segment] if finger == 'thumb' else segment.lower()}"
        label = f"{side.lower()} {'wrist' if joint == 'hand' else joint}" if side else joint
        seen.positions[label], seen.rotations[label] = MIRROR @ p, MIRROR @ R @ MIRROR
    seen.positions.pop("")
    return seen


def read_vmt(packets: list[bytes]) -> Seen:
    """As SteamVR through VMT: OpenVR's axes, bones below the device, each in its parent's axes."""
    names = {0: "left", 1: "right", 2: "left foot", 3: "right foot", 4: "hips", 10: "cube"}
    parents = {JOINTS.index(joint): JOINTS.index(parent) for joint, parent in _openxr_parents().items()}
    devices: dict[int, tuple[FloatArray, FloatArray]] = {}
    bones: dict[int, dict[int, tuple[FloatArray, FloatArray]]] = {}
    matrix_sent = False
    seen = Seen()
    for address, values in messages(packets):
        if address == "/VMT/Room/Driver":
            assert [type(value) for value in values] == [int, int, *[float] * 8]
            assert matrix_sent
            assert values[1] == {0: 5, 1: 6}.get(values[0], 1)
            devices[values[0]] = np.array(values[3:6]), matrix(values[6:])
        elif address == "/VMT/Skeleton/Driver":
            assert [type(value) for value in values] == [int, int, *[float] * 7]
            bones.setdefault(values[0], {})[values[1]] = np.array(values[2:5]), matrix(values[5:])
        elif address == "/VMT/Set/RoomMatrix/Temporary":
            assert values == [1.0, 0.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 0.0, 1.0, 0.0]
            matrix_sent = True
        else:
            assert (address, len(values)) == ("/VMT/Skeleton/Apply", 2)
            assert len(bones[values[0]]) == 31
    for number, (p, R) in devices.items():
        seen.positions[names[number]], seen.rotations[names[number]] = p, R
    for number, skeleton in bones.items():
        placed = {0: devices[number]}
        for bone in range(1, 31):
            p, R = placed[parents.get(bone, 0) if bone < 26 else 0]
            offset, turn = skeleton[bone]
            placed[bone] = p + R @ offset, R @ turn
        for bone in range(1, 26):
            seen.positions[f"{names[number]} {JOINTS[bone]}"] = placed[bone][0]
        for bone, finger in zip(range(26, 31), FINGERS, strict=True):
            assert np.allclose(placed[bone][0], placed[JOINTS.index(f"{finger}_distal")][0], atol=1e-4)
    return seen


def _openxr_parents() -> Mapping[str, str]:
    parents = {}
    for index, joint in enumerate(JOINTS[2:], 2):
        first = joint.endswith("_metacarpal")
        parents[joint] = "wrist" if first else JOINTS[index - 1]
    return parents


def read_lsl(packets: list[bytes]) -> Seen:
    """As a program that reads the channels' labels: positions in metres, quaternions w first."""
    seen = Seen()
    for name, joints in lsl_samples(packets).items():
        joints.pop("")
        for joint, value in joints.items():
            label = _label(name, joint)
            seen.positions[label] = np.array([value[f"Position{axis}"] for axis in "XYZ"])
            seen.rotations[label] = matrix([value[f"Orientation{part}"] for part in "BCDA"])
    return seen


def read_ros2(packets: list[bytes]) -> Seen:
    """As a ROS node: x forward, y left, z up."""
    seen = Seen()
    found = ros_messages(packets)
    stage = np.array([[0.0, -1.0, 0.0], [0.0, 0.0, 1.0], [-1.0, 0.0, 0.0]])
    transforms = {each.child_frame_id: each.transform for each in found.pop("/tf").transforms}
    for topic, message in found.items():
        name = topic.removeprefix("/rhot/")
        assert message.header.frame_id == "rhot_floor"
        poses = message.poses if hasattr(message, "poses") else [message.pose]
        joints = [name] if len(poses) == 1 else JOINTS
        for joint, pose in zip(joints, poses, strict=True):
            p, q = pose.position, pose.orientation
            seen.positions[_label(name, joint)] = stage @ np.array([p.x, p.y, p.z])
            seen.rotations[_label(name, joint)] = stage @ matrix([q.x, q.y, q.z, q.w])
    for child, transform in transforms.items():
        p = transform.translation
        thing = child.removesuffix("_wrist")
        label = _label(thing, "wrist" if child != thing else thing)
        assert np.allclose(stage @ np.array([p.x, p.y, p.z]), seen.positions[label])
    return seen


def _label(name: str, joint: str) -> str:
    """Return `left index_tip`, `left foot`, `cube` or `head`, as `Seen` has them."""
    kind, _, rest = name.partition("_")
    if kind == "hand":
        return f"{rest} {joint}"
    return {"foot": f"{rest} foot", "object": rest}.get(kind, name)


READERS: Final[Mapping[str, Callable[[list[bytes]], Seen]]] = {
    "json": read_json,
    "lsl": read_lsl,
    "ros2": read_ros2,
    "vmc": read_vmc,
    "vrchat": read_vrchat,
    "vmt": read_vmt,
}
