"""Avatars and SteamVR's hands beyond the known poses: what fades, what is out of reach, what is switched off."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from bridged import poses as bridge_poses
from bridged.readers import messages, read_vmc
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from rhot.anatomy.hand import WRIST
from rhot.geometry.rotations import rotation_from_quaternion
from rhot.messages import Side
from rhot_bridge.axes import Converter
from rhot_bridge.retarget.arms import two_bones
from rhot_bridge.retarget.vrm import conjugate, finger_bones, relative, right_product
from rhot_bridge.scene import Body, Scene
from rhot_bridge.targets.osc import MOST_BYTES, Template, bundles
from rhot_bridge.targets.vmc import VmcTarget
from rhot_bridge.targets.vmt import VmtTarget

SIDES: tuple[Side, Side] = ("left", "right")
COORDINATE = st.floats(-1.0, 1.0)
UNITY = Converter("unity", np.eye(4))


def random_rotations(seed: int, count: int) -> NDArray[np.float64]:
    found = np.random.default_rng(seed).normal(size=(count, 4))
    unit: NDArray[np.float64] = found / np.linalg.norm(found, axis=1, keepdims=True)
    return unit


def test_products_of_quaternions_are_products_of_rotations() -> None:
    p, q = random_rotations(1, 20), random_rotations(2, 20)
    P, Q = rotation_from_quaternion(p), rotation_from_quaternion(q)
    assert np.allclose(rotation_from_quaternion(relative(p, q)), np.swapaxes(P, -1, -2) @ Q)
    assert np.allclose(rotation_from_quaternion((p[:, None] @ right_product(q))[:, 0]), P @ Q)
    assert np.allclose(rotation_from_quaternion(conjugate(p)), np.swapaxes(P, -1, -2))
    assert np.allclose(relative(p[0], q)[3], relative(p[:1], q[3:4])[0])


def test_a_fading_fist_opens() -> None:
    fist = UNITY.poses(bridge_poses.hand("fist", "left"))
    bends = []
    for weight in (1.0, 0.7, 0.4, 0.1):
        quaternions = finger_bones({"left": dataclasses.replace(fist, weight=weight)})[0, :, 3:]
        assert np.allclose(np.linalg.norm(quaternions, axis=1), 1.0)
        bends.append(float(2.0 * np.degrees(np.arccos(np.clip(np.abs(quaternions[4, 3]), 0.0, 1.0)))))
    assert bends == sorted(bends, reverse=True)
    assert bends[0] > 80.0
    assert bends[-1] < 20.0


def test_of_two_hands_only_the_one_that_is_gone_fades() -> None:
    left, right = (UNITY.poses(bridge_poses.hand("fist", side)) for side in SIDES)
    together = finger_bones({"left": dataclasses.replace(left, weight=0.3), "right": right})
    assert np.allclose(together[0], finger_bones({"left": dataclasses.replace(left, weight=0.3)})[0])
    assert np.allclose(together[1], finger_bones({"right": right})[0])
    assert not np.allclose(together[0], finger_bones({"left": left})[0], atol=0.05)


def test_without_hands_an_avatar_keeps_its_own() -> None:
    addresses = [address for address, _ in messages(VmcTarget().frame(Scene("unity"), 0))]
    assert addresses == ["/VMC/Ext/OK", "/VMC/Ext/T"]


def test_fingers_alone_need_neither_arms_nor_head() -> None:
    bones = [
        values[0]
        for address, values in messages(VmcTarget().frame(UNITY.scene(bridge_poses.scene("flat")), 0))
        if address == "/VMC/Ext/Bone/Pos"
    ]
    assert len(bones) == 30
    assert {"LeftThumbProximal", "RightLittleDistal"} <= set(bones)
    assert "LeftHand" not in bones


@given(x=COORDINATE, y=COORDINATE, z=COORDINATE, first=st.floats(0.1, 0.5), second=st.floats(0.1, 0.5))
def test_two_bones_keep_their_lengths_wherever_the_wrist_is(
    x: float, y: float, z: float, first: float, second: float
) -> None:
    start, end = np.zeros(3), np.array([x, y, z])
    joint, reached, hinge = two_bones(start, end, first, second, np.array([0.4, -1.0, -0.3]))
    assert np.linalg.norm(joint) == pytest.approx(first, abs=1e-6)
    assert np.linalg.norm(reached - joint) == pytest.approx(second, abs=1e-6)
    assert abs(hinge @ joint) < 1e-6
    assert abs(hinge @ (reached - joint)) < 1e-6
    if abs(first - second) + 2e-3 < np.linalg.norm(end) < 0.998 * (first + second):
        assert np.allclose(reached, end, atol=1e-9)


def test_elbows_hang_outside_and_below() -> None:
    seen = read_vmc(VmcTarget("arms").frame(UNITY.scene(bridge_poses.scene("flat")), 0))
    for side, out in (("left", -1.0), ("right", 1.0)):
        arm = seen.hand(side)
        line = (arm["upperarm"] + arm["wrist"]) / 2.0
        assert (arm["lowerarm"] - line)[1] < -0.02
        assert out * (arm["lowerarm"] - line)[0] > 0.0
        # The avatar's T-pose x is along the arm, away from the body on the right.
        along = out * seen.rotations[f"{side} lowerarm"][:, 0]
        assert along @ (arm["wrist"] - arm["lowerarm"]) > 0.99 * 0.146 * 1.7


def test_legs_follow_the_body() -> None:
    names = ("hips", "left_hip", "left_knee", "left_ankle", "right_hip", "right_knee", "right_ankle")
    positions = np.array(
        [
            [0.0, 0.9, 0.0],
            [-0.1, 0.9, 0.0],
            [-0.1, 0.5, -0.1],
            [-0.1, 0.1, 0.0],
            [0.1, 0.9, 0.0],
            [0.1, 0.5, -0.2],
            [0.1, 0.1, 0.1],
        ]
    )
    body = Body(1, "measured", 1.0, positions, random_rotations(4, 7), names)
    scene = dataclasses.replace(bridge_poses.scene("flat"), body=body)
    seen = read_vmc(VmcTarget("arms").frame(UNITY.scene(scene), 0))
    for name, bone in zip(names, ("hips", "left upperleg", "left lowerleg", "left foot"), strict=False):
        row = names.index(name)
        assert seen.positions[bone] == pytest.approx(positions[row], abs=1e-5)
        assert np.allclose(seen.rotations[bone], rotation_from_quaternion(body.orientations[row]), atol=1e-5)


def test_spine_and_elbows_follow_a_body_that_has_them() -> None:
    names = ("hips", "spine_lower", "chest", "neck", "head", "left_shoulder", "left_elbow", "left_wrist")
    scene = bridge_poses.scene("flat")
    wrist = scene.hands["left"].positions[WRIST]
    shoulder = wrist + np.array([0.0, 0.3, 0.3])
    spine = [[0.0, 0.9, 0.0], [0.0, 1.0, 0.02], [0.0, 1.2, 0.03], [0.0, 1.45, 0.0], [0.0, 1.55, 0.0]]
    positions = np.array([*spine, shoulder, 0.5 * (shoulder + wrist) + [-0.2, 0.0, 0.0], wrist])
    body = Body(1, "measured", 1.0, positions, random_rotations(5, len(names)), names)
    seen = read_vmc(VmcTarget("arms").frame(UNITY.scene(dataclasses.replace(scene, body=body)), 0))
    for name, bone in (("spine_lower", "spine"), ("chest", "chest"), ("neck", "neck"), ("head", "head")):
        row = names.index(name)
        assert seen.positions[bone] == pytest.approx(positions[row], abs=1e-5)
        assert np.allclose(seen.rotations[bone], rotation_from_quaternion(body.orientations[row]), atol=1e-5)
    arm = seen.hand("left")
    for bone, row in (("upperarm", 5), ("lowerarm", 6), ("wrist", 7)):
        assert arm[bone] == pytest.approx(positions[row], abs=2e-3)


def devices(packets: list[bytes]) -> list[list[object]]:
    """Number and mode of each device in VMT's packets."""
    return sorted(values[:2] for address, values in messages(packets) if "Room/Driver" in address)


def test_a_device_that_is_gone_is_switched_off_for_a_second_and_the_room_is_told_again() -> None:
    target, scene = VmtTarget(), bridge_poses.scene("flat")
    target.frame(scene, 0)
    without = dataclasses.replace(scene, hands={"left": scene.hands["left"]}, objects={})
    for at_ns in (1, 500_000_000, 1_000_000_000):
        assert devices(target.frame(without, at_ns)) == [[0, 5], [1, 0], [2, 1], [3, 1], [10, 0]], "packets get lost"
    assert devices(target.frame(without, 1_000_000_001)) == [[0, 5], [2, 1], [3, 1]]
    assert any("RoomMatrix" in address for address, _ in messages(target.frame(without, 2_000_000_000)))


def test_devices_are_switched_off_when_the_bridge_ends() -> None:
    target = VmtTarget()
    assert target.closing_packets() == []
    target.frame(bridge_poses.scene("flat"), 0)
    assert devices(target.closing_packets()) == sorted(3 * [[0, 0], [1, 0], [2, 0], [3, 0], [10, 0]])
    assert target.closing_packets() == [], "once"


def test_an_object_that_is_new_takes_the_device_of_one_that_has_gone() -> None:
    target, cup = VmtTarget(), bridge_poses.thing((0.0, 1.0, 0.0))
    target.frame(Scene("stage", objects={f"cup{number}": cup for number in range(48)}), 0)
    there = {f"cup{number}": cup for number in range(1, 48)}
    later = target.frame(Scene("stage", objects=there | {"new": cup, "one too many": cup}), 5_000_000_000)
    assert devices(later) == [[number, 1] for number in range(10, 58)]


def test_names_that_come_and_go_do_not_pile_up() -> None:
    vmt, vmc = VmtTarget(), VmcTarget()
    cup = bridge_poses.thing((0.0, 1.0, 0.0))
    for number in range(200):
        scene = Scene("stage", objects={f"cup{number}": cup})
        packets = vmt.frame(scene, number)
        vmc.frame(scene, number)
        assert len(packets) <= 3, "48 devices, most of them off"
    assert len(vmt._objects) == 48, "as many devices as VMT has"
    assert len(vmc._trackers) == 1


def test_bundles_stay_below_a_network_frame_and_keep_the_order() -> None:
    template = Template("/a/long/address", "with text", 7, floats=3)
    packets = bundles(template.pack(float(number), 0.0, 0.0) for number in range(200))
    assert len(packets) > 1
    assert max(len(packet) for packet in packets) <= MOST_BYTES
    seen = [values for _, values in messages(packets)]
    assert [values[2] for values in seen] == list(range(200))
    assert seen[0][:2] == ["with text", 7]
    assert bundles([]) == []
