"""A recorded motion as a skeleton of constant bones that rotate.

Each joint but the root (a hand's wrist, a body's hips) hangs on its parent by an offset that is constant in the
parent's axes; its length is the median of the recorded bone's. Axes are the recorded ones, each rotated by the smallest
rotation that makes the bone to its child point where the recorded child is:

    p_child = p_parent + R_parent · offset_child

With constant bone lengths the joints of the fingers are met exactly, wherever the recorded axes point. A joint with
several children (the root, a body's chest) keeps its recorded axes.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from rhot.arrays import FloatArray
from rhot.geometry.rotations import quaternion_from_rotation, rotation_from_quaternion
from rhot_tools.export.poses import ExportedMotion, frame_times_s


@dataclass(frozen=True, slots=True)
class SkeletonMotion:
    """A skeleton over time.

    Attributes:
        joints: names of the J joints.
        parents: index of each joint's parent, −1 for the root.
        interval_s: time between frames.
        offsets: (J, 3) metres, each joint's position in its parent's axes; zero for the root.
        root: (N, 3) metres, position of the root.
        local: (N, J, 3, 3) rotation of each joint relative to its parent's; of the root in the motion's frame.
        timing_error_s: largest distance between a pose's time and that of its frame.
    """

    joints: tuple[str, ...]
    parents: tuple[int, ...]
    interval_s: float
    offsets: FloatArray
    root: FloatArray
    local: FloatArray
    timing_error_s: float

    def positions(self) -> FloatArray:
        """Return all joints (N, J, 3), metres, by forward kinematics."""
        positions = np.empty((len(self.root), len(self.joints), 3))
        rotations = np.empty((len(self.root), len(self.joints), 3, 3))
        for joint in tree_order(self.parents):
            parent = self.parents[joint]
            if parent < 0:
                positions[:, joint], rotations[:, joint] = self.root, self.local[:, joint]
                continue
            positions[:, joint] = positions[:, parent] + rotations[:, parent] @ self.offsets[joint]
            rotations[:, joint] = rotations[:, parent] @ self.local[:, joint]
        return positions


def tree_order(parents: Sequence[int]) -> list[int]:
    """Return the joints in an order in which parents come first."""

    def depth(joint: int) -> int:
        return 0 if parents[joint] < 0 else 1 + depth(parents[joint])

    return sorted(range(len(parents)), key=depth)


def skeleton_motion(motion: ExportedMotion, rate_hz: float | None = None) -> SkeletonMotion:
    """Fit a skeleton to a recorded motion.

    Args:
        motion: at least one pose.
        rate_hz: frames per second, poses between the recorded ones interpolated; None = every pose is one frame, and
            the interval between frames is the poses' mean interval.

    Raises:
        ConfigError: see `frame_times_s`.
    """
    t_s = (motion.t_ns - motion.t_ns[0]) / 1e9
    offsets = _offsets(motion)
    axes = _rotated_to_children(motion, offsets)
    local = axes.copy()
    for joint, parent in enumerate(motion.parents):
        if parent >= 0:
            local[:, joint] = np.swapaxes(axes[:, parent], -1, -2) @ axes[:, joint]
    root = motion.positions[:, motion.root]
    if rate_hz is None:
        interval_s = float(t_s[-1]) / (len(t_s) - 1) if len(t_s) > 1 else 1.0 / 60.0
        error_s = float(np.abs(t_s - interval_s * np.arange(len(t_s))).max())
        return SkeletonMotion(motion.joints, motion.parents, interval_s, offsets, root, local, error_s)
    frames_s = frame_times_s(float(t_s[-1]), rate_hz)
    before = np.clip(np.searchsorted(t_s, frames_s, side="right") - 1, 0, max(len(t_s) - 2, 0))
    after = np.minimum(before + 1, len(t_s) - 1)
    span_s = np.maximum(t_s[after] - t_s[before], 1e-9)
    share = np.clip((frames_s - t_s[before]) / span_s, 0.0, 1.0)
    root = root[before] + share[:, None] * (root[after] - root[before])
    local = rotations_between(local[before], local[after], share)
    return SkeletonMotion(motion.joints, motion.parents, 1.0 / rate_hz, offsets, root, local, 0.0)


def _offsets(motion: ExportedMotion) -> FloatArray:
    """Return each joint's constant position in its parent's axes: median direction, median length."""
    offsets = np.zeros((len(motion.joints), 3))
    for joint, parent in enumerate(motion.parents):
        if parent < 0:
            continue
        bones = motion.positions[:, joint] - motion.positions[:, parent]
        direction = np.median(_in_axes(motion.rotations[:, parent], bones), axis=0)
        length = float(np.median(np.linalg.norm(bones, axis=-1)))
        size = float(np.linalg.norm(direction))
        offsets[joint] = direction * (length / size) if size > 0.0 else (0.0, 0.0, -length)
    return offsets


def _rotated_to_children(motion: ExportedMotion, offsets: FloatArray) -> FloatArray:
    axes = motion.rotations.copy()
    for joint, parent in enumerate(motion.parents):
        if parent < 0 or parent == motion.root or motion.parents.count(parent) > 1:
            continue
        bones = motion.positions[:, joint] - motion.positions[:, parent]
        axes[:, parent] = _smallest_rotations(axes[:, parent] @ offsets[joint], bones) @ axes[:, parent]
    return axes


def _in_axes(rotations: FloatArray, vectors: FloatArray) -> FloatArray:
    rotated: FloatArray = (np.swapaxes(rotations, -1, -2) @ vectors[..., None])[..., 0]
    return rotated


def _smallest_rotations(start: FloatArray, end: FloatArray) -> FloatArray:
    """Return the smallest rotations (N, 3, 3) that rotate vectors `start` (N, 3) into the directions of `end` (N, 3).

    As quaternions: (start × end, start·end + |start|·|end|), normalised; opposite or zero vectors are left alone.
    """
    xyzw = np.empty((len(start), 4))
    xyzw[:, :3] = np.cross(start, end)
    size = np.linalg.norm(start, axis=-1) * np.linalg.norm(end, axis=-1)
    xyzw[:, 3] = np.einsum("ij,ij->i", start, end) + size
    xyzw[xyzw[:, 3] <= 1e-9 * np.maximum(size, 1e-12)] = (0.0, 0.0, 0.0, 1.0)
    return rotation_from_quaternion(xyzw)


def rotations_between(first: FloatArray, second: FloatArray, share: NDArray[np.float64]) -> FloatArray:
    """Return rotations (N, J, 3, 3) at shares (N,) of the shortest way between two (spherical interpolation)."""
    p, q = quaternion_from_rotation(first), quaternion_from_rotation(second)
    cosine = (p * q).sum(axis=-1, keepdims=True)
    q = np.where(cosine < 0.0, -q, q)
    angle = np.arccos(np.clip(np.abs(cosine), 0.0, 1.0))
    part = share[:, None, None]
    small = angle < 1e-6
    sine = np.where(small, 1.0, np.sin(angle))
    weight_p = np.where(small, 1.0 - part, np.sin((1.0 - part) * angle) / sine)
    weight_q = np.where(small, part, np.sin(part * angle) / sine)
    return rotation_from_quaternion(weight_p * p + weight_q * q)
