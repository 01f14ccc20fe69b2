"""How far tracked hands, points and objects are from the simulated world's truth."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from rhot.evaluate.collect import Arrival
from rhot.messages import HandPose, ObjectPose, PointSet
from rhot.sim.world import World
from rhot.skeleton import FINGERS, JOINTS

FloatArray = NDArray[np.float64]

TIPS: Final = tuple(f"{finger}_tip" for finger in FINGERS)
_TIP_ROWS: Final = [JOINTS.index(tip) for tip in TIPS]


@dataclass(frozen=True, slots=True)
class HandErrors:
    """Errors of one hand over N poses.

    Attributes:
        t_s: (N,) seconds since the start.
        tips_m: (N, 5) distance of each fingertip joint from its true place, NaN where the pose has none.
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


def hand_errors(world: World, start_t_ns: int, poses: Sequence[Arrival[HandPose]]) -> HandErrors:
    """Compare hand poses with the world at their own times."""
    t_s = seconds_since(start_t_ns, [arrival.message.t_ns for arrival in poses])
    tracked = np.full((len(poses), len(JOINTS), 3), np.nan)
    measured = np.zeros((len(poses), len(FINGERS)), dtype=np.bool_)
    for row, arrival in enumerate(poses):
        joints = arrival.message.joints
        tracked[row] = [joints[name].position if name in joints else (np.nan,) * 3 for name in JOINTS]
        measured[row] = [arrival.message.fingers.get(finger) == "measured" for finger in FINGERS]
    if not poses:
        return HandErrors(t_s, np.empty((0, 5)), np.empty((0, 26)), measured)
    true = world.sample(t_s).joints[poses[0].message.side].positions
    distances = np.linalg.norm(tracked - true, axis=2)
    return HandErrors(t_s, distances[:, _TIP_ROWS], distances, measured)


def point_errors(world: World, start_t_ns: int, sets: Sequence[Arrival[PointSet]]) -> dict[str, FloatArray]:
    """Return per marker the vector (N, 3) from its true to its measured place, metres; without the predicted."""
    if not sets:
        return {}
    t_s = seconds_since(start_t_ns, [arrival.message.t_ns for arrival in sets])
    truth = world.sample(t_s).markers
    errors: dict[str, FloatArray] = {}
    for name, true in truth.items():
        rows = [
            (row, arrival.message.points[name].position)
            for row, arrival in enumerate(sets)
            if name in arrival.message.points and arrival.message.points[name].state == "measured"
        ]
        if rows:
            errors[name] = np.array([position for _, position in rows]) - true[[row for row, _ in rows]]
    return errors


def object_errors(
    world: World, start_t_ns: int, poses: Mapping[str, Sequence[Arrival[ObjectPose]]]
) -> dict[str, tuple[FloatArray, FloatArray]]:
    """Return per object the distance (N,), metres, and the angle (N,), radians, to its true pose."""
    errors = {}
    for name, arrivals in poses.items():
        measured = [arrival.message for arrival in arrivals if arrival.message.state == "measured"]
        if not measured or name not in world.objects:
            continue
        t_s = seconds_since(start_t_ns, [message.t_ns for message in measured])
        T = world.sample(t_s).objects[name]
        distance = np.linalg.norm(np.array([message.position for message in measured]) - T[:, :3, 3], axis=1)
        R = _rotations(np.array([message.orientation for message in measured]))
        cosine = 0.5 * (np.einsum("nij,nij->n", R, T[:, :3, :3]) - 1.0)
        errors[name] = (distance, np.arccos(np.clip(cosine, -1.0, 1.0)))
    return errors


def _rotations(xyzw: FloatArray) -> FloatArray:
    """Return rotation matrices (N, 3, 3) of unit quaternions (N, 4), x y z w."""
    x, y, z, w = (xyzw / np.linalg.norm(xyzw, axis=1, keepdims=True)).T
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
        [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
        [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
    ]
    return np.moveaxis(np.array(rows), 2, 0)
