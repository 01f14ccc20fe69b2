"""Objects of the simulated world, as a tracking system would measure them."""

from __future__ import annotations

import zlib
from collections.abc import Callable, Mapping
from functools import partial
from typing import Final

import numpy as np

from rhot.geometry.rotations import quaternion_from_rotation, rotation_from_vector
from rhot.rig import Rig
from rhot_objects.pose import Pose, Registration
from rhot_objects.sources import HEAD, PoseSample
from rhot_sim.world.touching import T_DEVICE_OBJECT
from rhot_sim.world.world import World

POSITION_NOISE_M: Final = 0.3e-3
"""Standard deviation per axis; a Vive tracker at rest, rounded from published measurements of lighthouse tracking."""
ORIENTATION_NOISE_RAD: Final = float(np.radians(0.1))
"""Standard deviation per axis of the rotation vector."""

TruePoses = Callable[[float], Mapping[str, Pose]]
"""Seconds since the start of the world to T_rig_object by object id."""


class SimulatedSource:
    """The simulated objects in tracker space: the true pose through the inverse registration, plus noise.

    Like everything simulated it is a function of seed and time, whenever and however often it is asked.
    """

    def __init__(
        self, true_poses: TruePoses, registration: Registration, object_ids: frozenset[str], seed: int
    ) -> None:
        """Choose what to show.

        Args:
            true_poses: the world.
            registration: of the rig; it is applied backwards, so that the live chain is exercised as a whole.
            object_ids: which of the world's objects have a tracker.
            seed: of the noise.
        """
        self._true_poses = true_poses
        self._registration = registration
        self._object_ids = object_ids
        self._seed = seed
        self._start_ns: int | None = None

    def open(self, start_ns: int) -> None:
        """Let the world begin at the start of the session."""
        self._start_ns = start_ns

    def read(self, now_ns: int) -> Mapping[str, PoseSample]:
        """Return the objects at this moment; nothing before the start."""
        start_ns = self._start_ns
        if start_ns is None or now_ns < start_ns:
            return {}
        elapsed_ns = now_ns - start_ns
        return {
            object_id: PoseSample(now_ns, self._measure(object_id, T_rig_object, elapsed_ns))
            for object_id, T_rig_object in self._true_poses(elapsed_ns / 1e9).items()
            if object_id in self._object_ids
        }

    def close(self) -> None:
        """Leave the world."""
        self._start_ns = None

    def _measure(self, object_id: str, T_rig_object: Pose, elapsed_ns: int) -> Pose:
        true = self._registration.to_tracker(object_id, T_rig_object)
        random = np.random.default_rng([self._seed, zlib.crc32(object_id.encode()), elapsed_ns])
        jitter = Pose.from_arrays(
            np.zeros(3), quaternion_from_rotation(rotation_from_vector(random.normal(0.0, ORIENTATION_NOISE_RAD, 3)))
        )
        measured = true @ jitter
        return Pose.from_arrays(measured.position + random.normal(0.0, POSITION_NOISE_M, 3), measured.orientation_xyzw)


def simulated_objects(rig: Rig, registration: Registration, object_ids: frozenset[str]) -> SimulatedSource:
    """Return the source of a rig's simulated objects, not yet open.

    Objects coincide with their trackers as `registration` says, so that whatever it says is true; an object that is
    touched sits where it truly does.
    """
    if rig.config.sim.motion == "touch":
        offset = Pose.from_matrix(T_DEVICE_OBJECT)
        registration = Registration(registration.T_rig_tracker, dict.fromkeys(object_ids, offset))
    return SimulatedSource(partial(_object_poses, World.from_rig(rig)), registration, object_ids, rig.config.sim.seed)


def _object_poses(world: World, t_s: float) -> dict[str, Pose]:
    # The motion alone: the hands' joints would cost eight times as much.
    t = np.array([t_s])
    motion = world.motion.sample(t)
    poses = {name: Pose.from_matrix(T_rig_object[0]) for name, T_rig_object in motion.objects.items()}
    if world.walker is not None:
        poses[HEAD] = Pose.from_matrix(world.walker.head(t)[0])
    return poses
