"""Where a grasping session comes from: the simulated rig, rendered pictures, a recording, the running rig."""

from __future__ import annotations

import asyncio
import csv
import gzip
import json
from collections.abc import Callable
from pathlib import Path

import numpy as np

from rhot.arrays import FloatArray
from rhot.bus import Bus
from rhot.errors import BusError, ConfigError
from rhot.messages import CylinderShape, HandPose, Message, ObjectPose
from rhot.messages.base import wire_position
from rhot.offline import core, track_with
from rhot.recording import load_recording
from rhot.rig import BusConfig, Rig
from rhot_bench.measures.hands import START_NS
from rhot_bench.pictures.rendered import at_rate_of, found_markers, prepare_rig
from rhot_bench.speed.simulated import world_of
from rhot_bench.tracking.tracking import scene_frames
from rhot_objects.assemble import plan_sources
from rhot_objects.offline import PlayedObjects
from rhot_sim.world.world import World
from rhot_tools.grasp.pickups import as_true
from rhot_tools.grasp.session import PALM, GraspSession

SEQUENCE = "G2"
_CONNECT_S = 5.0


class _Posed:
    """One object whose poses are known beforehand."""

    def __init__(self, key: str, poses: list[ObjectPose]) -> None:
        self._key, self._poses, self._next = key, poses, 0

    def until(self, t_ns: int) -> list[tuple[str, Message]]:
        """Return the poses up to a time that were not returned before."""
        outputs: list[tuple[str, Message]] = []
        while self._next < len(self._poses) and self._poses[self._next].t_ns <= t_ns:
            outputs.append((self._key, self._poses[self._next]))
            self._next += 1
        return outputs


def simulated(
    rig: Rig, seconds: float, advance: Callable[[], None]
) -> tuple[list[tuple[str, Message]], Callable[[GraspSession], GraspSession]]:
    """Track the simulated rig's pictures; return what it publishes and what gives the truth beside a session."""
    world = world_of(rig, 1.0)
    frames = scene_frames(rig, world, seconds, advance)
    objects = PlayedObjects(plan_sources(rig), START_NS)
    messages = list(track_with(core("fusion")(rig), core("ik")(rig), frames, objects))
    return messages, lambda session: _truth(session, world)


def rendered(data: Path, keep: Path, advance: Callable[[], None] = lambda: None) -> list[tuple[str, Message]]:
    """Track the rendered grasp; its object stands where the truth says, as a tracker on it would tell."""
    rig = prepare_rig(data, keep / "rig")
    frames = found_markers(rig, data, SEQUENCE, keep, advance)
    at_rate = at_rate_of(rig, load_recording(data / SEQUENCE))
    objects = _Posed("rhot/object/cylinder", _rendered_object(data))
    return list(track_with(core("fusion")(at_rate), core("ik")(at_rate), frames, objects))


async def listened(
    bus_config: BusConfig, seconds: float, progress: Callable[[float], None]
) -> list[tuple[str, Message]]:
    """Return what the running rig publishes of hands and objects.

    Args:
        bus_config: how to reach it.
        seconds: how long to listen.
        progress: called with the seconds that have passed.

    Raises:
        BusError: no router, or nothing came.
    """
    messages: list[tuple[str, Message]] = []
    async with await Bus.open(bus_config, timeout_s=_CONNECT_S) as bus:
        begun = asyncio.get_running_loop().time()

        async def follow(keys: str, model: type[Message]) -> None:
            async for sample, message in bus.events(keys).messages(model):
                progress(asyncio.get_running_loop().time() - begun)
                messages.append((sample.key, message))

        try:
            async with asyncio.timeout(seconds), asyncio.TaskGroup() as tasks:
                tasks.create_task(follow("rhot/hand/*", HandPose))
                tasks.create_task(follow("rhot/object/*", ObjectPose))
        except TimeoutError:
            pass
    if not messages:
        raise BusError(
            f"no hand and no object came in {seconds:g} s; is the rig running and started (see `rhot status`)?"
        )
    return sorted(messages, key=lambda each: each[1].t_ns)


def _truth(session: GraspSession, world: World) -> GraspSession:
    sample = world.sample(np.asarray((session.t_ns - START_NS) * 1e-9, dtype=np.float64))
    (joints,) = sample.joints.values()
    (objects,) = sample.objects.values()
    return as_true(session, joints.positions, joints.rotations[:, PALM], objects)


def _rendered_object(data: Path) -> list[ObjectPose]:
    """Return the true poses of the rendered object, rig frame.

    Raises:
        ConfigError: the files are not as their README says.
    """
    file = data / SEQUENCE / "truth_500hz.csv.gz"
    try:
        size = json.loads((data / "hand.json").read_text(encoding="utf-8"))["object"]
        shape = CylinderShape(radius=1e-3 * size["radius_mm"], height=1e-3 * size["height_mm"])
        with gzip.open(file, "rt", encoding="utf-8", newline="") as lines:
            return [_object_pose(row, shape) for row in csv.DictReader(lines)]
    except (OSError, KeyError, ValueError) as error:
        raise ConfigError(f"{file}: cannot be used as the truth of the rendered object: {error}") from error


def _object_pose(row: dict[str, str], shape: CylinderShape) -> ObjectPose:
    position: FloatArray = 1e-3 * np.array([float(row[f"obj_{axis}"]) for axis in "xyz"])
    x, y, z, w = (float(row[f"obj_q{axis}"]) for axis in "xyzw")
    return ObjectPose(
        t_ns=int(row["t_ns"]),
        frame="rig",
        position=wire_position(position),
        orientation=(x, y, z, w),
        state="measured",
        shape=shape,
    )
