"""JSON frames, read by Python's own parser."""

from __future__ import annotations

import json

import numpy as np
import pytest
from bridged import poses as bridge_poses

from rhot.anatomy.skeleton import JOINTS
from rhot.messages import BoxShape
from rhot_bridge.scene import Body, Scene, Thing
from rhot_bridge.targets.json_text import JsonTarget


def test_a_frame_holds_all_that_is_known() -> None:
    scene = bridge_poses.scene("pointing")
    cube = scene.objects["cube"]
    box = Thing(1, "predicted", 0.5, cube.positions, cube.orientations, BoxShape(size=(0.1, 0.2, 0.3)))
    body = Body(1, "measured", 1.0, np.ones((2, 3)), np.tile([0.0, 0.0, 0.0, 1.0], (2, 1)), ("hips", "left_knee"))
    full = Scene("stage", 1_700_000_000_123_456_789, scene.hands, {'cu"be': box}, scene.head, scene.feet, body)
    (packet,) = JsonTarget("stage").frame(full, 0)
    assert len(packet) < 8192
    frame = json.loads(packet)
    assert frame["t"] == pytest.approx(1_700_000_000.123457, abs=2e-6)
    assert (frame["version"], frame["axes"]) == (1, "stage")
    for hand in frame["hands"]:
        wanted = scene.hands[hand["side"]]
        positions = np.array(hand["positions"]).reshape(26, 3)
        orientations = np.array(hand["orientations"]).reshape(26, 4)
        assert np.abs(positions - wanted.positions).max() < 1e-5
        assert np.abs(orientations - wanted.orientations).max() < 1e-5
        assert len(hand["radii"]) == len(JOINTS)
        assert (hand["state"], hand["weight"]) == ("measured", 1.0)
    assert frame["objects"] == [
        {
            "id": 'cu"be',
            "state": "predicted",
            "weight": 0.5,
            "position": [0.0, 0.75, -0.6],
            "orientation": [0.0, 0.0, 0.0, 1.0],
            "shape": {"kind": "box", "size": [0.1, 0.2, 0.3]},
        }
    ]
    assert frame["head"]["position"] == [0.0, 1.6, -0.1]
    assert [foot["side"] for foot in frame["feet"]] == ["left", "right"]
    assert [joint["name"] for joint in frame["body"]["joints"]] == ["hips", "left_knee"]


def test_a_frame_without_anything_still_says_that_the_rig_is_there() -> None:
    (packet,) = JsonTarget("unity").frame(Scene("unity"), 0)
    assert json.loads(packet) == {"version": 1, "t": 0.0, "axes": "unity", "hands": [], "objects": [], "feet": []}
