"""How far tracked hands, points and objects are from the simulated world's truth."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from rhot.anatomy.skeleton import FINGERS, JOINTS
from rhot.arrays import FloatArray
from rhot.geometry.rotations import rotation_from_quaternion
from rhot_sim.comparison.collect import HandSample, ObjectSample, PointsSample
from rhot_sim.rendering.coverage import MarkerCoverage
from rhot_sim.world.world import World

# How much of what both cameras could see was tracked.

VISIBLE_SHARE: Final = 0.25
"""A marker counts as visible to a camera when at least this share of its whole silhouette is.

Skin hides the rear of a painted fingertip: an unhidden one shows about half of its silhouette.
"""
NEAR_FRAMES: Final = 1.5
"""A sample is tracked when a point set lies this near to it, in frames of a camera."""


@dataclass(frozen=True, slots=True)
class Coverage:
    """Shares of the samples that at least two cameras could see.

    Attributes:
        samples: number of (moment, marker) pairs.
        measured: share that was reported as measured.
        reported: share that was reported, predicted ones included.
        by_marker: measured share per marker.
    """

    samples: int
    measured: float
    reported: float
    by_marker: dict[str, float]


def visible_to_two(cameras: Mapping[str, MarkerCoverage], t_s: float) -> set[str]:
    """Return the markers that at least two cameras can see at a moment."""
    counts: Counter[str] = Counter()
    for camera in cameras.values():
        for name, view in camera.at(t_s).items():
            counts[name] += view.shows(VISIBLE_SHARE)
    return {name for name, number in counts.items() if number >= 2}


def coverage(
    cameras: Mapping[str, MarkerCoverage],
    times_s: NDArray[np.float64],
    points: Sequence[PointsSample],
    points_t_s: NDArray[np.float64],
    rate_hz: float,
) -> Coverage:
    """Compare what could be seen with what was reported.

    Args:
        cameras: what the true cameras see.
        times_s: (N,) moments to look at, seconds since the start.
        points: reported point sets in order of time.
        points_t_s: (M,) their times, seconds since the start.
        rate_hz: of the cameras.
    """
    visible: Counter[str] = Counter()
    measured: Counter[str] = Counter()
    reported: Counter[str] = Counter()
    for t_s in times_s.tolist():
        near = np.flatnonzero(np.abs(points_t_s - t_s) <= NEAR_FRAMES / rate_hz)
        nearest = [points[int(row)] for row in near[np.argsort(np.abs(points_t_s[near] - t_s))][:2]]
        for name in visible_to_two(cameras, t_s):
            visible[name] += 1
            seen = any(name in sample.measured for sample in nearest)
            measured[name] += seen
            reported[name] += seen or any(name in sample.predicted for sample in nearest)
    total = sum(visible.values())
    return Coverage(
        samples=total,
        measured=sum(measured.values()) / total if total else 0.0,
        reported=sum(reported.values()) / total if total else 0.0,
        by_marker={name: measured[name] / number for name, number in sorted(visible.items())},
    )


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
