"""A hand as balls and rods."""

from __future__ import annotations

import numpy as np
import pytest
from stub_rig import StubRig

from rhot.anatomy.skeleton import CHAINS, JOINTS
from rhot.messages import HandPose
from rhot_viewer.scene.drawn import (
    BONE_COLOR,
    GHOST_SWELL,
    JOINT_COLOR,
    PREDICTED_BONE,
    PREDICTED_JOINT,
    fingertips,
    ghost_shape,
    hand_shape,
)


@pytest.fixture
def pose(stub: StubRig) -> HandPose:
    message = stub.messages(1.0, 10**18, 0)["rhot/hand/right"]
    assert isinstance(message, HandPose)
    return message


def test_every_bone_ends_in_joints(pose: HandPose) -> None:
    shape = hand_shape(pose)
    assert shape is not None
    centers = np.array([pose.joints[name].position for name in JOINTS])
    assert len(shape.joints) == 25, "all joints but the palm's, which is no joint"
    assert len(shape.bones) == 24 + 3, "a bone to each of them, and three links between the knuckles"
    for position, wxyz, scale in zip(shape.bones.positions, shape.bones.wxyzs, shape.bones.scales, strict=True):
        w, x, y, z = wxyz
        along = np.array([2 * (x * z + w * y), 2 * (y * z - w * x), 1 - 2 * (x * x + y * y)]) * scale[2] / 2
        for end in (position - along, position + along):
            assert np.linalg.norm(centers - end, axis=1).min() < 2e-5
        assert 0.003 < scale[0] < 0.04


def test_a_predicted_finger_looks_different_and_the_others_do_not(pose: HandPose) -> None:
    shape = hand_shape(pose)
    assert shape is not None
    colors = {
        joint: tuple(color)
        for joint, color in zip([n for n in JOINTS if n != "palm"], shape.joints.colors, strict=True)
    }
    assert {colors[joint] for joint in CHAINS["little"][1:]} == {PREDICTED_JOINT}
    assert colors["little_metacarpal"] == JOINT_COLOR["right"], "it belongs to the palm"
    assert {colors[joint] for joint in CHAINS["index"]} == {JOINT_COLOR["right"]}
    bones = [tuple(color) for color in shape.bones.colors]
    assert bones.count(PREDICTED_BONE) == 4 + 1, "the little finger's bones and its link to the next knuckle"
    assert bones.count(BONE_COLOR["right"]) == len(bones) - 5


def test_a_predicted_hand_is_predicted_all_over(pose: HandPose) -> None:
    shape = hand_shape(pose.model_copy(update={"fingers": {}, "state": "predicted"}))
    assert shape is not None
    assert {tuple(color) for color in shape.joints.colors} == {PREDICTED_JOINT}


def test_the_ghost_is_thicker_by_its_share(stub: StubRig, pose: HandPose) -> None:
    truth = stub.world.truth(1.0, 10**18)
    radii = np.full(26, 0.01)
    shape = ghost_shape(truth.hands["right"], radii)
    assert shape is not None
    assert shape.joints.scales[1:] == pytest.approx(0.01 * GHOST_SWELL, abs=1e-5), "but for the wrist"
    tracked = hand_shape(pose)
    assert tracked is not None
    apart_mm = 1e3 * np.linalg.norm(shape.joints.positions - tracked.joints.positions, axis=1)
    assert apart_mm == pytest.approx(2.0, abs=1e-3), "the stub's hand stands 2 mm beside the truth"


def test_a_hand_with_a_joint_missing_is_not_drawn(stub: StubRig, pose: HandPose) -> None:
    joints = {name: joint for name, joint in pose.joints.items() if name != "ring_distal"}
    assert hand_shape(pose.model_copy(update={"joints": joints})) is None
    truth = stub.world.truth(1.0, 10**18).hands["right"]
    assert ghost_shape({name: truth[name] for name in joints}, np.ones(26)) is None
    assert fingertips("right", pose.model_copy(update={"joints": {}})) == {}
    assert fingertips("right", pose)["right index"] == pose.joints["index_tip"].position
