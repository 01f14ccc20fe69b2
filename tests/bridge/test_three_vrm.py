"""VMC received by a program that is not ours: the humanoid of npm's @pixiv/three-vrm, over loopback."""

from __future__ import annotations

import asyncio
import json
from pathlib import Path
from typing import Any

import numpy as np
from bridged import poses as bridge_poses
from bus_watch import PATIENCE_S

from rhot.anatomy.hand import HandModel
from rhot.anatomy.skeleton import CHAINS, FINGERS, JOINTS
from rhot.arrays import FloatArray
from rhot.geometry.rotations import quaternion_from_rotation, rotation_from_quaternion, rotation_from_vector
from rhot.messages import Side
from rhot_bridge.axes import Converter
from rhot_bridge.links import UdpLink
from rhot_bridge.scene import BridgedHand, Scene
from rhot_bridge.targets.osc import Template, bundles
from rhot_bridge.targets.vmc import VmcTarget
from rhot_sim.world.world import World

SCALE = 1.25
"""The avatar's hand is larger than ours."""
FRAMES = 90
SIDES: tuple[Side, Side] = ("left", "right")
LIMIT_M, LIMIT_DEG = 0.003, 3.0


def wrist_axes(side: Side) -> FloatArray:
    """OpenXR's wrist axes, as columns, in an avatar's T-pose in three.js's axes of VRM 1: +z forward, +x left, +y up.

    The arm points sideways and the palm down; −Z is forward along the hand, +Y out of its back.
    """
    out = 1.0 if side == "left" else -1.0
    z, y = np.array([-out, 0.0, 0.0]), np.array([0.0, 1.0, 0.0])
    return np.stack([np.cross(y, z), y, z], axis=1)


def thumb_axes(side: Side) -> FloatArray:
    """The same of the thumb, which points halfway forward; its back faces forward and inwards."""
    out = np.sqrt(0.5) * (1.0 if side == "left" else -1.0)
    z, y = np.array([-out, 0.0, -np.sqrt(0.5)]), np.array([-out, 0.0, np.sqrt(0.5)])
    return np.stack([np.cross(y, z), y, z], axis=1)


def rest_axes(side: Side, finger: str) -> FloatArray:
    return thumb_axes(side) if finger == "thumb" else wrist_axes(side)


def bone_names(side: Side, finger: str) -> list[str]:
    """The avatar's bones of a finger, and its tip, in the order of our four joints from the knuckle on."""
    parts = ("Metacarpal", "Proximal", "Distal") if finger == "thumb" else ("Proximal", "Intermediate", "Distal")
    return [f"{side}{finger.capitalize()}{part}" for part in (*parts, "Tip")]


def avatar(models: dict[Side, HandModel]) -> dict[str, dict[str, Any]]:
    """A VRM 1 skeleton in its T-pose whose hands are ours, scaled; its bones' own axes lie anyhow, as in real files."""
    random = np.random.default_rng(7)
    bones: dict[str, dict[str, Any]] = {}

    def bone(name: str, parent: str, position: FloatArray) -> None:
        rest = quaternion_from_rotation(rotation_from_vector(random.normal(size=3)))
        bones[name] = {"parent": parent, "position": position.tolist(), "rest": rest.tolist()}

    bone("hips", "", np.array([0.0, 0.9, 0.0]))
    bone("spine", "hips", np.array([0.0, 1.0, 0.0]))
    bone("head", "spine", np.array([0.0, 1.5, 0.0]))
    for side in SIDES:
        out = 1.0 if side == "left" else -1.0
        for name, parent, height in (("UpperLeg", "hips", 0.85), ("LowerLeg", f"{side}UpperLeg", 0.45)):
            bone(f"{side}{name}", parent, np.array([0.1 * out, height, 0.0]))
        bone(f"{side}Foot", f"{side}LowerLeg", np.array([0.1 * out, 0.08, 0.0]))
        bone(f"{side}UpperArm", "spine", np.array([0.18 * out, 1.4, 0.0]))
        bone(f"{side}LowerArm", f"{side}UpperArm", np.array([0.45 * out, 1.4, 0.0]))
        wrist = np.array([0.7 * out, 1.4, 0.0])
        bone(f"{side}Hand", f"{side}LowerArm", wrist)
        model = models[side]
        for number, finger in enumerate(FINGERS):
            place, parent = wrist + SCALE * wrist_axes(side) @ model.knuckles[number], f"{side}Hand"
            lengths = (*model.bones[number], 0.0)
            for name, length in zip(bone_names(side, finger), lengths, strict=True):
                bone(name, parent, place)
                place, parent = place - SCALE * length * rest_axes(side, finger)[:, 2], name
    return bones


def grasps(models: dict[Side, HandModel]) -> list[dict[Side, BridgedHand]]:
    """Both hands while they gesture and grasp in the simulated world, as scenes in the rig's axes hold them."""
    sample = World(3, models, {}, ("cube",)).sample(np.linspace(0.5, 18.0, FRAMES))
    return [
        {
            side: BridgedHand(
                frame,
                "measured",
                1.0,
                joints.positions[frame],
                quaternion_from_rotation(joints.rotations[frame]),
                models[side].radii,
            )
            for side, joints in sample.joints.items()
        }
        for frame in range(FRAMES)
    ]


async def received(folder: Path, bones: dict[str, dict[str, Any]], hands: list[dict[Side, BridgedHand]]) -> list[Any]:
    """Send all frames to the receiver and return what it says of each."""
    target, converter = VmcTarget(), Converter("unity", bridge_poses.T_RIG_STAGE)
    (folder / "avatar.json").write_text(json.dumps(bones))
    process = await asyncio.create_subprocess_exec(
        "node", "vrm_receiver.mjs", "avatar.json", cwd=folder, stdout=asyncio.subprocess.PIPE
    )
    assert process.stdout is not None
    try:
        async with asyncio.timeout(PATIENCE_S):
            link = UdpLink("127.0.0.1", int(await process.stdout.readline()))
            await link.open()
            seen = []
            for number, each in enumerate(hands):
                packets = target.frame(converter.scene(Scene("rig", 1, each)), number * 11_000_000)
                assert link.wanted(number)
                assert link.send([*packets, *bundles([Template("/test/show", floats=0).pack()])]) == 0
                seen.append(json.loads(await process.stdout.readline()))
            link.send(bundles([Template("/test/end", floats=0).pack()]))
            await link.close()
            assert await process.wait() == 0
    finally:
        if process.returncode is None:
            process.kill()
            await process.wait()
    return seen


def reach(hand: BridgedHand) -> float:
    """How far the tip of the forefinger is from the wrist, metres."""
    return float(np.linalg.norm(hand.positions[JOINTS.index("index_tip")] - hand.positions[JOINTS.index("wrist")]))


async def test_fingers_of_a_vrm_avatar_are_where_ours_are(web: Path) -> None:
    models = dict(bridge_poses.MODELS)
    hands = grasps(models)
    assert all(np.ptp([reach(each[side]) for each in hands]) > 0.05 for side in SIDES)
    seen = await received(web, avatar(models), hands)
    assert len(seen) == FRAMES
    distances: list[float] = []
    angles: list[float] = []
    for each, ours in zip(seen, hands, strict=True):
        for side, hand in ours.items():
            axes = rotation_from_quaternion(hand.orientations)
            wrist, at = axes[JOINTS.index("wrist")], hand.positions[JOINTS.index("wrist")]
            base = np.array(each[f"{side}Hand"]["position"])
            for finger in FINGERS:
                joints = CHAINS[finger][-4:]
                for name, joint in zip(bone_names(side, finger), joints, strict=True):
                    row = JOINTS.index(joint)
                    in_hand = wrist.T @ (hand.positions[row] - at)
                    theirs = wrist_axes(side).T @ (np.array(each[name]["position"]) - base) / SCALE
                    distances.append(float(np.linalg.norm(in_hand - theirs)))
                    if each[name]["rotation"] is not None:
                        turned = rotation_from_quaternion(np.array(each[name]["rotation"])) @ rest_axes(side, finger)
                        difference = wrist_axes(side).T @ turned @ (wrist.T @ axes[row]).T
                        cosine = np.clip((np.trace(difference) - 1.0) / 2.0, -1.0, 1.0)
                        angles.append(float(np.degrees(np.arccos(cosine))))
    assert len(angles) == FRAMES * 2 * 15
    assert max(distances) < LIMIT_M
    assert max(angles) < LIMIT_DEG
