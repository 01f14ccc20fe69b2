"""A hand's recorded motion as a skeleton of constant bones that turn.

Each joint but the wrist hangs on its parent by an offset that is constant in the parent's axes; its length is the
median of the recorded bone's. Axes are the recorded ones (OpenXR), each rotated by the smallest rotation that makes the
bone to its child point where the recorded child is:

    p_child = p_parent + R_parent · offset_child

With constant bone lengths the joints of the fingers are met exactly, wherever the recorded axes point. The wrist has
six children and keeps its recorded axes.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from rhot.anatomy.hand import WRIST
from rhot.anatomy.skeleton import JOINTS, PARENTS
from rhot.export.poses import FloatArray, HandMotion
from rhot.geometry.rotations import quaternion_from_rotation, rotation_from_quaternion

PARENT_OF: Final = tuple(-1 if (parent := PARENTS[name]) is None else JOINTS.index(parent) for name in JOINTS)
"""(26,) index in `JOINTS` of each joint's parent, −1 for the wrist."""
TREE_ORDER: Final = (WRIST, *(joint for joint in range(len(JOINTS)) if joint != WRIST))
"""Joints in an order in which parents come first."""


@dataclass(frozen=True, slots=True)
class SkeletonMotion:
    """A skeleton over time.

    Attributes:
        interval_s: time between frames.
        offsets: (26, 3) metres, each joint's position in its parent's axes; zero for the wrist.
        root: (N, 3) metres, position of the wrist, rig frame.
        local: (N, 26, 3, 3) rotation of each joint relative to its parent's; of the wrist relative to the rig frame.
        timing_error_s: largest distance between a pose's time and that of its frame.
    """

    interval_s: float
    offsets: FloatArray
    root: FloatArray
    local: FloatArray
    timing_error_s: float

    def positions(self) -> FloatArray:
        """Return all joints (N, 26, 3), metres, rig frame, by forward kinematics."""
        positions = np.empty((len(self.root), len(JOINTS), 3))
        rotations = np.empty((len(self.root), len(JOINTS), 3, 3))
        for joint in TREE_ORDER:
            parent = PARENT_OF[joint]
            if parent < 0:
                positions[:, joint], rotations[:, joint] = self.root, self.local[:, joint]
                continue
            positions[:, joint] = positions[:, parent] + rotations[:, parent] @ self.offsets[joint]
            rotations[:, joint] = rotations[:, parent] @ self.local[:, joint]
        return positions


def skeleton_motion(motion: HandMotion, rate_hz: float | None = None) -> SkeletonMotion:
    """Fit a skeleton to a recorded motion.

    Args:
        motion: at least one pose.
        rate_hz: frames per second, poses between the recorded ones interpolated; None = every pose is one frame, and
            the interval between frames is the poses' mean interval.
    """
    t_s = (motion.t_ns - motion.t_ns[0]) / 1e9
    offsets = _offsets(motion)
    axes = _turned_to_children(motion, offsets)
    local = axes.copy()
    for joint, parent in enumerate(PARENT_OF):
        if parent >= 0:
            local[:, joint] = np.swapaxes(axes[:, parent], -1, -2) @ axes[:, joint]
    root = motion.positions[:, WRIST]
    if rate_hz is None:
        interval_s = float(t_s[-1]) / (len(t_s) - 1) if len(t_s) > 1 else 1.0 / 60.0
        error_s = float(np.abs(t_s - interval_s * np.arange(len(t_s))).max())
        return SkeletonMotion(interval_s, offsets, root, local, error_s)
    frames_s = np.arange(int(t_s[-1] * rate_hz + 1e-6) + 1) / rate_hz
    before = np.clip(np.searchsorted(t_s, frames_s, side="right") - 1, 0, max(len(t_s) - 2, 0))
    after = np.minimum(before + 1, len(t_s) - 1)
    span_s = np.maximum(t_s[after] - t_s[before], 1e-9)
    share = np.clip((frames_s - t_s[before]) / span_s, 0.0, 1.0)
    root = root[before] + share[:, None] * (root[after] - root[before])
    return SkeletonMotion(1.0 / rate_hz, offsets, root, _between(local[before], local[after], share), 0.0)


def _offsets(motion: HandMotion) -> FloatArray:
    """Return each joint's constant position in its parent's axes: median direction, median length."""
    offsets = np.zeros((len(JOINTS), 3))
    for joint, parent in enumerate(PARENT_OF):
        if parent < 0:
            continue
        bones = motion.positions[:, joint] - motion.positions[:, parent]
        direction = np.median(_in_axes(motion.rotations[:, parent], bones), axis=0)
        length = float(np.median(np.linalg.norm(bones, axis=-1)))
        size = float(np.linalg.norm(direction))
        offsets[joint] = direction * (length / size) if size > 0.0 else (0.0, 0.0, -length)
    return offsets


def _turned_to_children(motion: HandMotion, offsets: FloatArray) -> FloatArray:
    axes = motion.rotations.copy()
    for joint, parent in enumerate(PARENT_OF):
        if parent < 0 or parent == WRIST:
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


def _between(first: FloatArray, second: FloatArray, share: NDArray[np.float64]) -> FloatArray:
    """Return rotations (N, 26, 3, 3) on the shortest way from `first` to `second` (spherical interpolation)."""
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
