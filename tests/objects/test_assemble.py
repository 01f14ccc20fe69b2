from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from rhot.errors import ConfigError
from rhot.messages import ObjectPose
from rhot.rig import Rig, load_rig
from rhot.rig.folder import registration_path
from rhot_objects.assemble import plan_sources
from rhot_objects.pose import Pose, angle_between
from rhot_objects.sources import PoseSample
from rhot_sim.world.world import World

START = 1_700_000_000_000_000_000

RIG = """
[cameras.left]
source = "simulated"

[markers.index]
joint = "index_tip"
"""


def rig_with(folder: Path, objects: str) -> Rig:
    (folder / "rig.toml").write_text(RIG + objects, encoding="utf-8")
    (folder / "registration.json").write_text(
        '{"T_rig_tracker": {"position": [0.5, 1.0, 1.5], "orientation": [0.5, 0.5, 0.5, 0.5]},'
        ' "T_tracker_object": {"cup": {"position": [0.0, 0.0, 0.05], "orientation": [0.0, 0.0, 0.0, 1.0]}}}',
        encoding="utf-8",
    )
    return load_rig(folder)


def test_one_source_for_each_tracking_system(tmp_path: Path) -> None:
    plans = plan_sources(
        rig_with(
            tmp_path,
            """
            [objects.cup]
            source = "steamvr"
            serial = "LHR-1"
            rate_hz = 60
            [objects.head]
            source = "steamvr"
            serial = "LHR-2"
            rate_hz = 120
            [objects.pen]
            source = "recorded"
            path = "pen.csv"
            [objects.knife]
            source = "recorded"
            path = "knife.csv"
            rate_hz = 30
            """,
        )
    )
    assert {plan.name: plan.rate_hz for plan in plans} == {
        "steamvr": 120.0,
        "recorded.pen": 90.0,
        "recorded.knife": 30.0,
    }


def test_no_objects_need_no_source(tmp_path: Path) -> None:
    assert plan_sources(rig_with(tmp_path, "")) == []


def test_one_tracker_cannot_be_two_objects(tmp_path: Path) -> None:
    rig = rig_with(tmp_path, '[objects.cup]\nserial = "LHR-1"\n[objects.pen]\nserial = "LHR-1"\n')
    with pytest.raises(ConfigError, match=r"rig\.toml: objects\.cup and objects\.pen both have serial 'LHR-1'"):
        plan_sources(rig)


def test_a_recording_lies_in_the_rig_folder(tmp_path: Path) -> None:
    (tmp_path / "pen.csv").write_text("t_ns,x,y,z,qx,qy,qz,qw\n0,0,0,0,0,0,0,1\n10,0,0,0,0,0,0,1\n", encoding="utf-8")
    (plan,) = plan_sources(rig_with(tmp_path, '[objects.pen]\nsource = "recorded"\npath = "pen.csv"\n'))
    plan.source.open(START)
    ((key, message),) = plan.core.feed(plan.source.read(START), START)
    assert key == "rhot/object/pen"
    assert isinstance(message, ObjectPose)
    assert message.position == pytest.approx((0.5, 1.0, 1.5))


def test_simulated_objects_come_out_where_the_world_has_them(tmp_path: Path) -> None:
    rig = rig_with(tmp_path, '[objects.cup]\nsource = "simulated"\n')
    (plan,) = plan_sources(rig)
    world = World.from_rig(rig)
    plan.source.open(START)
    for elapsed_s in (0.0, 1.5, 4.25, 60.0):
        now_ns = START + round(elapsed_s * 1e9)
        ((_, message),) = plan.core.feed(plan.source.read(now_ns), now_ns)
        assert isinstance(message, ObjectPose)
        true = world.truth(elapsed_s, now_ns).objects["cup"]
        error_mm = 1e3 * sum((a - b) ** 2 for a, b in zip(message.position, true.position, strict=True)) ** 0.5
        assert error_mm < 2.0
        angle = angle_between(
            Pose.from_arrays(message.position, message.orientation), Pose.from_arrays(true.position, true.orientation)
        )
        assert angle < 0.01


def test_each_source_has_a_registration_of_its_own_else_the_one_of_all(tmp_path: Path) -> None:
    """Rigs of earlier versions have one file for everything; it goes on holding for what has none of its own."""
    objects = """
        [objects.cup]
        source = "steamvr"
        serial = "LHR-1"
        [objects.pen]
        source = "recorded"
        path = "pen.csv"
        """
    (tmp_path / "registration.steamvr.json").write_text(
        '{"T_rig_tracker": {"position": [7.0, 0.0, 0.0], "orientation": [0.0, 0.0, 0.0, 1.0]}}'
    )
    rig = rig_with(tmp_path, objects)
    assert registration_path(tmp_path, "steamvr") == tmp_path / "registration.steamvr.json"
    assert registration_path(tmp_path, "recorded") == tmp_path / "registration.json"
    here = {
        "cup": PoseSample(START, Pose.from_matrix(np.eye(4))),
        "pen": PoseSample(START, Pose.from_matrix(np.eye(4))),
    }
    positions = {}
    for plan in plan_sources(rig):
        for key, message in plan.core.feed(here, START):
            assert isinstance(message, ObjectPose)
            positions[plan.name, key] = message.position
    assert positions["steamvr", "rhot/object/cup"] == (7.0, 0.0, 0.0)
    assert positions["recorded.pen", "rhot/object/pen"] == (0.5, 1.0, 1.5)
