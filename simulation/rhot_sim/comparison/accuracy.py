"""How far tracked hands, points and objects are from the simulated world's truth."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from rhot.anatomy.skeleton import FINGERS, JOINTS
from rhot.arrays import FloatArray
from rhot.geometry.rotations import rotation_from_quaternion
from rhot_sim.comparison.collect import HandSample, ObjectSample, PointsSample
from rhot_sim.world.world import World

TIPS: Final = tuple(f"{finger}_tip" for finger in FINGERS)
_TIP_ROWS: Final = [JOINTS.index(tip) for tip in TIPS]


@dataclass(frozen=True, slots=True)
class HandErrors:
    """Errors of one hand over N poses.

    Attributes:
        t_s: (N,) seconds since the start.
        tips_m: (N, 5) distance of each fingertip joint from its true position, NaN where the pose has none.
        joints_m: (N, 26) the same for all joints.
        measured: (N, 5) whether the pose says that the finger was measured.
    """

    t_s: FloatArray
    tips_m: FloatArray
    joints_m: FloatArray
    measured: NDArray[np.bool_]


def seconds_since(start_t_ns: int, t_ns: Sequence[int]) -> FloatArray:
    """Return times (N,) as seconds since the start."""
    # Subtracted as integers: a float64 cannot hold nanoseconds since 1970.
    return np.array([(t - start_t_ns) / 1e9 for t in t_ns], dtype=np.float64)


def hand_errors(world: World, start_t_ns: int, poses: Sequence[HandSample]) -> HandErrors:
    """Compare poses of one hand with the world at their own times."""
    t_s = seconds_since(start_t_ns, [pose.t_ns for pose in poses])
    if not poses:
        return HandErrors(t_s, np.empty((0, 5)), np.empty((0, 26)), np.empty((0, 5), dtype=np.bool_))
    tracked = np.stack([pose.positions for pose in poses]).astype(np.float64)
    true = world.sample(t_s).joints[poses[0].side].positions
    distances = np.linalg.norm(tracked - true, axis=2)
    return HandErrors(t_s, distances[:, _TIP_ROWS], distances, np.array([pose.measured for pose in poses]))


def point_errors(world: World, start_t_ns: int, sets: Sequence[PointsSample]) -> dict[str, FloatArray]:
    """Return per marker the vector (N, 3) from its true to its measured position, metres, without the predicted."""
    if not sets:
        return {}
    truth = world.sample(seconds_since(start_t_ns, [points.t_ns for points in sets])).markers
    errors: dict[str, FloatArray] = {}
    for name, true in truth.items():
        rows = [row for row, points in enumerate(sets) if name in points.measured]
        if rows:
            errors[name] = np.array([sets[row].measured[name] for row in rows]) - true[rows]
    return errors


def object_errors(
    world: World, start_t_ns: int, poses: Mapping[str, Sequence[ObjectSample]]
) -> dict[str, tuple[FloatArray, FloatArray]]:
    """Return per object the distance (N,), metres, and the angle (N,), radians, to its true pose."""
    errors = {}
    for name, samples in poses.items():
        measured = [sample for sample in samples if sample.measured]
        if not measured or name not in world.objects:
            continue
        T = world.sample(seconds_since(start_t_ns, [sample.t_ns for sample in measured])).objects[name]
        distance = np.linalg.norm(np.array([sample.position for sample in measured]) - T[:, :3, 3], axis=1)
        R = rotation_from_quaternion(np.array([sample.orientation for sample in measured]))
        cosine = 0.5 * (np.einsum("nij,nij->n", R, T[:, :3, :3]) - 1.0)
        errors[name] = (distance, np.arccos(np.clip(cosine, -1.0, 1.0)))
    return errors
