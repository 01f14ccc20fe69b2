"""Where boards and cameras stand before the adjustment: pose candidates, and the consensus among them.

A plane seen by one camera has two poses that fit nearly as well (Schweighofer and Pinz, "Robust Pose Estimation from a
Planar Target", PAMI 2006). Both are kept here; the right one is that which agrees with the other pictures about how the
cameras stand to each other.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import product

import cv2
import numpy as np

from rhot.arrays import FloatArray
from rhot.geometry.rotations import inverse, nearest_rotation, rigid, rotation_from_vector, vector_from_rotation
from rhot_calibration.cameras.bundle.lens import camera_matrix

Key = tuple[str, int]

AGREE_ANGLE_RAD = float(np.radians(1.5))
"""Relative poses of two cameras from two pictures agree within this angle before the adjustment …"""
AGREE_SHARE = 0.025
"""… and within this share of the board's distance."""


@dataclass(frozen=True, slots=True)
class Candidate:
    """A possible pose of the board in one picture.

    Attributes:
        T: (4, 4) T_camera_board, metres.
        error_px: reprojection RMS.
        turned: the board, which looks the same after half a turn, was numbered from its other end.
    """

    T: FloatArray
    error_px: float
    turned: bool = False


@dataclass(frozen=True, slots=True)
class Relation:
    """How two cameras stand to each other.

    Attributes:
        T: (4, 4) T_second_first.
        agreeing: numbers of the pictures that say so.
        others: numbers of the pictures of both cameras that say something else.
    """

    T: FloatArray
    agreeing: tuple[int, ...]
    others: tuple[int, ...]


def angle_of(R: FloatArray) -> float:
    """Return the angle of a rotation (3, 3), radians."""
    return float(np.linalg.norm(vector_from_rotation(R)))


def pose_candidates(points: FloatArray, corners: FloatArray, lens: FloatArray) -> list[Candidate]:
    """Return the one or two poses of a flat board, better first; none when no pose puts it in front of the camera.

    Args:
        points: (n, 3) metres, board frame, z = 0.
        corners: (n, 2) pixels, raw image.
        lens: (9,).
    """
    K, distortion = camera_matrix(lens), lens[4:]
    flat = np.ascontiguousarray(points * (1.0, 1.0, 0.0))
    try:
        count, turns, shifts, errors = cv2.solvePnPGeneric(flat, corners, K, distortion, flags=cv2.SOLVEPNP_IPPE)
    except cv2.error:
        return []
    found = []
    for turn, shift, error in zip(turns[:count], shifts[:count], np.ravel(errors)[:count], strict=True):
        T = rigid(rotation_from_vector(np.ravel(turn)), np.ravel(shift))
        if np.isfinite(T).all() and (flat @ T[2, :3] + T[2, 3]).min() > 0.0:
            found.append(Candidate(T, float(error)))
    found.sort(key=lambda each: each.error_px)
    # The second pose of a plane is kept when its error is at most so many times the first's ….
    # … or below this.
    return [each for each in found if each.error_px <= max(4.0 * found[0].error_px, 1.0) or each is found[0]]


def agree(first: FloatArray, second: FloatArray, distance_m: float) -> bool:
    """Return whether two transforms (4, 4) say the same of a board at a distance."""
    turn = angle_of(first[:3, :3] @ second[:3, :3].T)
    shift = float(np.linalg.norm(first[:3, 3] - second[:3, 3]))
    return turn < AGREE_ANGLE_RAD and shift < AGREE_SHARE * distance_m + turn * distance_m


def mean_transform(transforms: Sequence[FloatArray]) -> FloatArray:
    """Return the mean of transforms (4, 4) that lie close together: chordal mean of rotations, median of places."""
    stack = np.stack(transforms)
    return rigid(nearest_rotation(stack[:, :3, :3].mean(axis=0)), np.median(stack[:, :3, 3], axis=0))


def relate(first: Mapping[int, Sequence[Candidate]], second: Mapping[int, Sequence[Candidate]]) -> Relation | None:
    """Return how two cameras stand to each other, as most of their common pictures say; None without any.

    Args:
        first, second: picture number to the board's pose candidates in each camera.
    """
    common = sorted(first.keys() & second.keys())
    claims = {
        number: [
            (b.T @ inverse(a.T), float(np.linalg.norm(b.T[:3, 3])), a.error_px + b.error_px)
            for a, b in product(first[number], second[number])
        ]
        for number in common
    }
    best: tuple[int, float, FloatArray, tuple[int, ...]] | None = None
    for number in common:
        for T, _, error in claims[number]:
            supporters = tuple(
                other for other in common if any(agree(T, each, distance) for each, distance, _ in claims[other])
            )
            if best is None or (len(supporters), -error) > best[:2]:
                best = (len(supporters), -error, T, supporters)
    if best is None:
        return None
    _, _, T, supporters = best
    chosen = [min(claims[number], key=lambda claim: float(np.abs(claim[0] - T).sum()))[0] for number in supporters]
    others = tuple(number for number in common if number not in supporters)
    return Relation(mean_transform(chosen), supporters, others)


def spanning_tree(
    relations: Mapping[tuple[str, str], Relation], cameras: Sequence[str]
) -> tuple[dict[str, FloatArray], list[list[str]]]:
    """Return the pose of each camera through the strongest chain of relations.

    Args:
        relations: (first, second) camera to how they stand.
        cameras: all names; the first is the reference.

    Returns:
        T_camera_rig (4, 4) of every camera that is linked to the reference, and the groups of cameras that are linked
        among each other, the reference's first.
    """
    edges = sorted(relations.items(), key=lambda item: -len(item[1].agreeing))
    groups = {name: [name] for name in cameras}
    neighbours: dict[str, list[tuple[str, FloatArray]]] = {name: [] for name in cameras}
    for (first, second), relation in edges:
        if groups[first] is groups[second]:
            continue
        neighbours[first].append((second, relation.T))
        neighbours[second].append((first, inverse(relation.T)))
        merged = groups[first] + groups[second]
        for name in merged:
            groups[name] = merged
    poses = {cameras[0]: np.eye(4)}
    waiting = [cameras[0]]
    while waiting:
        name = waiting.pop()
        for other, T_other_name in neighbours[name]:
            if other not in poses:
                poses[other] = T_other_name @ poses[name]
                waiting.append(other)
    distinct: list[list[str]] = []
    for name in cameras:
        if not any(name in group for group in distinct):
            distinct.append(sorted(groups[name], key=list(cameras).index))
    return poses, distinct
