"""Shapes of objects from `rig.toml` to the message, live and offline."""

from __future__ import annotations

from pathlib import Path

import pytest
import things

from rhot.errors import ConfigError
from rhot.messages import (
    BoxShape,
    CylinderShape,
    MarkerFrame,
    MeshShape,
    ObjectPose,
    PointSet,
    SphereShape,
    decode,
    encode,
)
from rhot.offline import track_with
from rhot.rig import Rig, load_rig
from rhot_objects.assemble import plan_sources
from rhot_objects.offline import RecordedObjects
from rhot_objects.pose import Pose
from rhot_objects.sources import PoseSample
from rhot_sim.world.motion import OBJECT_SIZE_M
from rhot_sim.world.world import World

MS = 1_000_000
RIG = """
[cameras.left]
source = "simulated"

[markers.index]
joint = "index_tip"
"""
CUP = """
[objects.cup]
source = "recorded"
path = "cup.csv"
rate_hz = 50
shape = { kind = "cylinder", radius = 0.04, height = 0.1 }
"""


def rig_with(folder: Path, objects: str) -> Rig:
    (folder / "rig.toml").write_text(RIG + objects, encoding="utf-8")
    rows = "".join(f"{1000 * MS + 100 * MS * k},0.0,0.0,{0.5 + 0.01 * k},0,0,0,1\n" for k in range(11))
    (folder / "cup.csv").write_text("t_ns,x,y,z,qx,qy,qz,qw\n" + rows, encoding="utf-8")
    return load_rig(folder)


@pytest.mark.parametrize(
    ("text", "shape"),
    [
        ('{ kind = "box", size = [0.1, 0.2, 1] }', BoxShape(size=(0.1, 0.2, 1.0))),
        ('{ kind = "cylinder", radius = 0.04, height = 0.1 }', CylinderShape(radius=0.04, height=0.1)),
        ('{ kind = "sphere", radius = 0.03 }', SphereShape(radius=0.03)),
    ],
)
def test_what_rig_toml_states_is_on_the_wire(
    tmp_path: Path, text: str, shape: BoxShape | CylinderShape | SphereShape
) -> None:
    rig = rig_with(tmp_path, f'[objects.cup]\nsource = "recorded"\npath = "cup.csv"\nshape = {text}\n')
    (plan,) = plan_sources(rig)
    level = PoseSample(1, Pose.from_arrays((0.0, 0.0, 1.0), (0.0, 0.0, 0.0, 1.0)))
    ((_, pose),) = plan.core.feed({"cup": level}, 1)
    assert decode(encode(pose), ObjectPose).shape == shape


def test_a_mesh_is_on_the_wire_by_its_planes_and_a_bad_file_stops_the_start(tmp_path: Path) -> None:
    things.save(things.mug(), tmp_path / "cup.glb")
    cup = '[objects.cup]\nsource = "recorded"\npath = "cup.csv"\nshape = { kind = "mesh", file = "cup.glb" }\n'
    rig = rig_with(tmp_path, cup)
    (plan,) = plan_sources(rig)
    level = PoseSample(1, Pose.from_arrays((0.0, 0.0, 1.0), (0.0, 0.0, 0.0, 1.0)))
    ((_, pose),) = plan.core.feed({"cup": level}, 1)
    shape = decode(encode(pose), ObjectPose).shape
    assert isinstance(shape, MeshShape)
    assert shape.size == pytest.approx((0.08, 0.095, 0.115), abs=1e-4)
    (tmp_path / "cup.glb").write_bytes(b"no glTF any more")
    with pytest.raises(ConfigError, match=r"cup\.glb: is no glTF"):
        plan_sources(rig)


@pytest.mark.parametrize(
    "text",
    [
        '{ kind = "cone", radius = 0.04 }',
        '{ kind = "cylinder", radius = 0.04 }',
        '{ kind = "sphere", radius = -0.04 }',
        '{ kind = "sphere", radius = 0.04, height = 0.1 }',
        '"cylinder"',
        '{ kind = "mesh" }',
        '{ kind = "mesh", file = "cup.glb", scale = 0 }',
    ],
)
def test_a_shape_that_is_none_is_refused_by_name(tmp_path: Path, text: str) -> None:
    with pytest.raises(ConfigError, match=r"objects\.cup\.shape"):
        rig_with(tmp_path, f'[objects.cup]\nsource = "recorded"\npath = "cup.csv"\nshape = {text}\n')


def test_the_simulated_world_draws_its_own_box_only(tmp_path: Path) -> None:
    simulated = '[objects.cube]\nsource = "simulated"\nshape = '
    size = OBJECT_SIZE_M.tolist()
    assert World.from_rig(rig_with(tmp_path, f'{simulated}{{ kind = "box", size = {size} }}\n')).objects == ("cube",)
    with pytest.raises(ConfigError, match=r"objects\.cube: the simulated world has boxes of 100 x 60 x 65 mm only"):
        World.from_rig(rig_with(tmp_path, f'{simulated}{{ kind = "sphere", radius = 0.04 }}\n'))


class Listener:
    """Stands for both cores: publishes a point set a frame and notes which objects it has heard of by then."""

    def __init__(self) -> None:
        self.objects: list[ObjectPose] = []

    def feed(self, frame: MarkerFrame | PointSet) -> list[tuple[str, PointSet]]:
        """Answer a frame with points."""
        if isinstance(frame, PointSet):
            return []
        return [("rhot/points", PointSet(t_ns=frame.t_ns, frame="rig", points={}))]

    def feed_object(self, pose: ObjectPose) -> None:
        """Note an object."""
        self.objects.append(pose)


def test_recorded_objects_play_beside_recorded_cameras(tmp_path: Path) -> None:
    frames = [
        MarkerFrame(t_ns=9_000 * MS + k * 40 * MS, camera="left", width=640, height=480, markers={}) for k in range(6)
    ]
    heard = Listener()
    out = list(track_with(heard, heard, frames, RecordedObjects(rig_with(tmp_path, CUP))))
    poses = [message for _, message in out if isinstance(message, ObjectPose)]
    assert heard.objects == poses
    # 50 Hz from the first frame to the last one, 0.1 m/s along z; none after the frame that comes with it.
    assert [pose.t_ns for pose in poses] == [frames[0].t_ns + 20 * MS * k for k in range(11)]
    assert [pose.position[2] for pose in poses] == pytest.approx([0.5 + 0.002 * k for k in range(11)])
    cup = CylinderShape(radius=0.04, height=0.1)
    assert all(pose.shape is not None and pose.shape.model_dump() == cup.model_dump() for pose in poses)
    times = [message.t_ns for _, message in out]
    assert times == sorted(times)
