"""Views of a marker from a moving head, and a first idea of where camera and marker are.

It comes from the marker's middle alone, whose position one picture tells well: 24 rotations of the camera are tried,
each refined, and the best one goes on. Of the two poses that each picture of a square allows those are taken that agree
on how the marker lies.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import permutations, product
from typing import Final

import cv2
import numpy as np

from rhot.arrays import FloatArray
from rhot.errors import CalibrationError
from rhot.geometry.camera import CameraModel
from rhot.geometry.rotations import cross_matrix, nearest_rotation, rotation_from_vector
from rhot.geometry.transforms import rigid

_STEPS: Final = 12


@dataclass(frozen=True, slots=True)
class HeadsetView:
    """One picture of the marker.

    Attributes:
        t_ns: middle of the exposure, rig clock.
        T_rig_head: (4, 4) at that time, metres.
        velocity: (6,) of the head there: rotation vector (rad/s), then position (m/s), rig axes.
        corners: (4, 2) pixels, as OpenCV's detector orders them.
        corner_sigma_px: their standard deviation per axis.
    """

    t_ns: int
    T_rig_head: FloatArray
    velocity: FloatArray
    corners: FloatArray
    corner_sigma_px: float


def first_poses(
    views: Sequence[HeadsetView], camera: CameraModel, square: FloatArray, guess: FloatArray | None
) -> tuple[FloatArray, FloatArray]:
    """Return T_head_camera and T_rig_marker (4, 4) to begin with.

    Args:
        views: of the marker.
        camera: the lens.
        square: (4, 3) corners of the marker in its own frame, metres.
        guess: (4, 4) T_head_camera to try first.

    Raises:
        CalibrationError: the corners of a view are no square.
    """
    seen = [_solutions(view, camera, square) for view in views]
    middles = np.stack([solutions[0][:3, 3] for solutions in seen])
    R = np.stack([view.T_rig_head[:3, :3] for view in views])
    t = np.stack([view.T_rig_head[:3, 3] for view in views])
    starts = _cube_rotations() if guess is None else [guess[:3, :3], *_cube_rotations()]
    found = [_middles_fitted(start, middles, R, t) for start in starts]
    _, T_head_camera = min(found, key=lambda each: each[0])
    # Of both poses of each square those belong together that agree on how the marker lies in the rig.
    poses = np.stack(
        [[T @ T_head_camera @ pose for pose in each] for T, each in zip(_rigid_all(R, t), seen, strict=True)]
    )
    flat = poses.reshape(-1, 4, 4)
    cosines = np.einsum("aij,nsij->ans", flat[:, :3, :3], poses[:, :, :3, :3])
    best = int(np.argmax(np.median(cosines.max(axis=2), axis=1)))
    return T_head_camera, rigid(flat[best, :3, :3], np.median(flat[:, :3, 3], axis=0))


def _middles_fitted(start: FloatArray, middles: FloatArray, R: FloatArray, t: FloatArray) -> tuple[float, FloatArray]:
    """Return cost and T_head_camera for which all middles (N, 3), camera frame, are one point of the rig.

    R_i · (R_X · m_i + t_X) + t_i = p is linear in t_X and p; the rotation R_X is improved step by step.
    """
    count, R_X = len(middles), start.copy()
    linear = np.concatenate([R.reshape(-1, 3), np.tile(-np.eye(3), (count, 1))], axis=1)
    solution = np.zeros(6)
    residual = np.zeros(3 * count)
    for _ in range(_STEPS):
        turned = middles @ R_X.T
        here = np.einsum("nij,nj->ni", R, turned) + t
        lever = cross_matrix(-turned)
        A = np.concatenate([(R @ lever).reshape(-1, 3), linear], axis=1)
        solution_all = np.linalg.lstsq(A, -here.ravel(), rcond=1e-8)[0]
        turn, solution = solution_all[:3], solution_all[3:]
        longest_step_rad = 0.7
        R_X = nearest_rotation(
            rotation_from_vector(turn * min(1.0, longest_step_rad / max(float(np.linalg.norm(turn)), 1e-9))) @ R_X
        )
        residual = np.einsum("nij,nj->ni", R, middles @ R_X.T).ravel() + t.ravel() + linear @ solution
    # Robust: one wrong view must not decide which rotation is best.
    cost = float(np.median(np.linalg.norm(residual.reshape(-1, 3), axis=1)))
    return cost, rigid(R_X, solution[:3])


def _solutions(view: HeadsetView, camera: CameraModel, square: FloatArray) -> list[FloatArray]:
    """Return the two poses (4, 4) T_camera_marker of a square that a view allows, the likelier one first."""
    count, turns, shifts, _ = cv2.solvePnPGeneric(
        square, view.corners, camera.K, camera.distortion, flags=cv2.SOLVEPNP_IPPE_SQUARE
    )
    if not count:
        raise CalibrationError("a view of the marker has no pose: its corners are no square")
    poses = [
        rigid(rotation_from_vector(np.ravel(turn)), np.ravel(shift)) for turn, shift in zip(turns, shifts, strict=True)
    ]
    return poses if len(poses) == 2 else poses * 2


def _cube_rotations() -> list[FloatArray]:
    """Return the 24 rotations of a cube (3, 3)."""
    found = []
    for order in permutations(range(3)):
        for signs in product((1.0, -1.0), repeat=3):
            R = np.zeros((3, 3))
            R[range(3), order] = signs
            if np.linalg.det(R) > 0.0:
                found.append(R)
    return found


def _rigid_all(R: FloatArray, t: FloatArray) -> list[FloatArray]:
    return [rigid(one, shift) for one, shift in zip(R, t, strict=True)]
