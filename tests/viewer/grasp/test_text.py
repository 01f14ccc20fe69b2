"""What the page is sent is what the rig says."""

from __future__ import annotations

import dataclasses
import json

import numpy as np
import pytest
from stub_rig import StubRig

from rhot.anatomy.hand import HandModel
from rhot.anatomy.skeleton import FINGERS, JOINTS
from rhot.messages import BoxShape, HandPose, ObjectPose, PointSet, Side, Space, Truth
from rhot.rig import RegistrationFile, Rig, load_rig, write_json_model
from rhot.rig.calibration import RigidTransform, matrix4
from rhot.rig.config import ObjectConfig
from rhot.rig.folder import REGISTRATION_FILE
from rhot_viewer.grasp.hello import hello_text, rest_hand, stage_of, webxr_of
from rhot_viewer.grasp.text import text_of

T_NS = 1_700_000_000_123_456_789


def test_a_hand_travels_to_a_hundredth_of_a_millimetre(stub: StubRig) -> None:
    hand = stub.messages(2.5, T_NS, 1)["rhot/hand/right"]
    assert isinstance(hand, HandPose)
    sent = json.loads(text_of(hand) or "")
    numbers = np.array(sent["joints"]).reshape(26, 7)
    assert numbers[:, :3] == pytest.approx(np.array([hand.joints[name].position for name in JOINTS]), abs=1e-5)
    assert numbers[:, 3:] == pytest.approx(np.array([hand.joints[name].orientation for name in JOINTS]), abs=1e-6)
    assert sent["t"] == pytest.approx(T_NS / 1e6, abs=1e-3)
    assert sent["predicted"] == ["little"]
    assert len(sent["radii"]) == 26


def test_a_hand_without_all_joints_is_not_sent(stub: StubRig) -> None:
    hand = stub.messages(2.5, T_NS, 1)["rhot/hand/right"]
    assert isinstance(hand, HandPose)
    less = {name: joint for name, joint in hand.joints.items() if name != "palm"}
    assert text_of(hand.model_copy(update={"joints": less})) is None


def test_objects_bring_their_shape_where_it_is_known() -> None:
    box = ObjectPose(
        t_ns=T_NS,
        frame="rig",
        position=(0.1, 0.2, 0.3),
        orientation=(0.0, 0.0, 0.0, 1.0),
        state="measured",
        shape=BoxShape(size=(0.1, 0.2, 0.3)),
    )
    assert json.loads(text_of(box) or "")["shape"] == {"kind": "box", "size": [0.1, 0.2, 0.3]}
    assert "shape" not in json.loads(text_of(box.model_copy(update={"shape": None})) or "")


def test_truth_and_spaces_are_json_and_points_are_not_sent(stub: StubRig) -> None:
    messages = stub.messages(2.5, T_NS, 1)
    truth, points = messages["rhot/truth"], messages["rhot/points"]
    assert isinstance(truth, Truth)
    assert isinstance(points, PointSet)
    sent = json.loads(text_of(truth) or "")
    assert len(sent["hands"]["right"]) == 26 * 7
    assert len(sent["objects"]["cube"]) == 7
    assert text_of(points) is None
    space = Space(t_ns=T_NS, T_rig_space=matrix4(np.eye(4)), source='a "board"')
    assert json.loads(text_of(space) or "")["source"] == 'a "board"'


def test_the_skin_is_made_in_a_hand_with_spread_fingers(rig: Rig) -> None:
    sides: tuple[Side, ...] = ("left", "right")
    for side in sides:
        rest = rest_hand(rig, side)
        model = HandModel.from_file(rig.hand, side)
        positions = np.array(rest["joints"]).reshape(26, 7)[:, :3]
        tips = positions[[JOINTS.index(f"{finger}_tip") for finger in FINGERS]]
        radii = model.radii[[JOINTS.index(f"{finger}_tip") for finger in FINGERS]]
        gaps = np.linalg.norm(np.diff(tips, axis=0), axis=1) - radii[:-1] - radii[1:]
        assert gaps.min() > 0.009, f"{side}: fingers grow together"


def test_the_page_is_told_where_floor_and_desk_are(rig: Rig) -> None:
    T_rig_stage, source = stage_of(rig)
    assert source.startswith("a guess")
    up = T_rig_stage[:3, 1]
    assert up == pytest.approx(np.array([0.0, 0.0, -1.0]))
    assert -T_rig_stage[:3, 2] == pytest.approx(np.array([0.0, 1.0, 0.0])), "forward is down the picture"
    hello = json.loads(hello_text(rig, {"index": (1, 2, 3)}, "http://localhost:8080", True, ["head"]))
    assert hello["paint"]["right"]["index"] == [1, 2, 3]
    assert hello["desk"]["height_m"] == pytest.approx(0.74)
    assert hello["devices"] == ["head"]


def test_a_headset_is_aligned_by_its_own_registration(rig: Rig) -> None:
    moved = RegistrationFile(T_rig_tracker=RigidTransform(position=(0.5, 0.0, 0.0), orientation=(0.0, 0.0, 0.0, 1.0)))
    headset = {"head": ObjectConfig(source="webxr")}
    alone = dataclasses.replace(rig, config=rig.config.model_copy(update={"objects": headset}))
    assert webxr_of(rig) is None
    assert webxr_of(alone) is None
    own = webxr_of(dataclasses.replace(rig, registrations={"webxr": moved}))
    assert own is not None
    assert own[3] == 0.5
    write_json_model(rig.path / REGISTRATION_FILE, moved)
    assert webxr_of(load_rig(rig.path)) is None, "that of the other tracking system"
    assert webxr_of(dataclasses.replace(alone, registration=moved)) is not None
