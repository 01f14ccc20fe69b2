"""The true geometry of simulated cameras, and what a calibration would have found of it."""

from __future__ import annotations

import zlib
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Any, Final

import cv2
import numpy as np

from rhot.arrays import FloatArray
from rhot.geometry.camera import CameraModel, epipolar_distance, meeting_points
from rhot.geometry.rotations import inverse, rigid, rotation_from_vector, vector_from_rotation
from rhot.rig.calibration import CameraCalibration, CamerasFile, today
from rhot.rig.cameras import camera_entry, camera_model, camera_models
from rhot.rig.config import CameraConfig
from rhot.rig.folder import Rig
from rhot_sim.world.script import seeded

BASELINE_M: Final = 0.075
"""Distance of the second camera, to the right of the first."""
DISTORTION: Final = (0.16, -0.36, 0.0006, -0.0004, 0.18)
"""k1, k2, p1, p2, k3 of a Raspberry Pi camera's lens, about."""
FOCUS_Z_M: Final = 0.82
"""Further cameras look at the middle of where hands are, this far in front of the first."""

FOCAL_ERROR: Final = 0.002
CENTER_ERROR_PX: Final = 0.5
DISTORTION_ERROR: Final = 0.02
"""Largest errors of the intrinsics that a calibration would have found, each evenly drawn within its bounds."""
CORNER_SIGMA_PX: Final = 0.1
"""Noise of the chessboard corners to which the poses are then fitted."""


@dataclass(frozen=True)
class SimulatedCalibration:
    """Geometry of the simulated cameras.

    Attributes:
        truth: what the pictures are rendered with.
        found_intrinsics: K (3, 3) and distortion (5,) of each camera, with a calibration's errors.
        seed: of the world.
    """

    truth: CamerasFile
    found_intrinsics: Mapping[str, tuple[FloatArray, FloatArray]]
    seed: int

    @cached_property
    def found(self) -> CamerasFile:
        """The geometry that the tracker works with. Renderers, which need only the truth, start sooner without it."""
        found = _poses_found(self.truth.cameras, self.found_intrinsics, self.seed)
        stated = _quality(self.truth.cameras, found, self.seed)
        quality = {"source": "simulated", "seed": self.seed, "errors": "as of a calibration", **stated}
        return CamerasFile(date=today(), quality=quality, cameras=found)


def simulated_rig_calibration(cameras: Mapping[str, CameraConfig], seed: int) -> SimulatedCalibration:
    """Return true and found geometry of a rig's cameras.

    The first camera is the reference and defines the rig frame; the second stands 75 mm to its right and is rotated by
    about 1°; further ones stand around and look at where hands are. A camera's geometry follows from the seed, its
    name and its number alone.

    Args:
        cameras: by name, in the order of `rig.toml`.
        seed: of the world.
    """
    truth: dict[str, CameraCalibration] = {}
    found_intrinsics: dict[str, tuple[FloatArray, FloatArray]] = {}
    for index, (name, camera) in enumerate(cameras.items()):
        rng = seeded(seed, 20, index, zlib.crc32(name.encode()))
        K = _intrinsics(camera, rng)
        distortion = np.array(DISTORTION) * rng.uniform(0.85, 1.15, 5)
        T = _pose(index, rng)
        truth[name] = camera_entry(CameraModel.from_arrays(camera.width, camera.height, K, distortion, T))
        found_intrinsics[name] = _intrinsics_found(K, distortion, rng)
    quality = {"source": "simulated", "seed": seed, "errors": "none"}
    return SimulatedCalibration(CamerasFile(date=today(), quality=quality, cameras=truth), found_intrinsics, seed)


def true_cameras(rig: Rig) -> dict[str, CameraModel]:
    """Return the true geometry of a rig's simulated cameras, which their calibration only approaches.

    They stay where they were calibrated when `rig.toml` gets another seed.
    """
    made = rig.quality if isinstance(rig.quality, dict) and rig.quality.get("source") == "simulated" else {}
    seed = made.get("seed")
    seed = seed if isinstance(seed, int) and seed >= 0 else rig.config.sim.seed
    return camera_models(simulated_rig_calibration(rig.config.cameras, seed).truth.cameras)


def _intrinsics_found(K: FloatArray, distortion: FloatArray, rng: np.random.Generator) -> tuple[FloatArray, FloatArray]:
    """Return intrinsics with a calibration's errors."""
    K_found = K.copy()
    K_found[[0, 1], [0, 1]] *= 1.0 + rng.uniform(-FOCAL_ERROR, FOCAL_ERROR)
    K_found[:2, 2] += rng.uniform(-CENTER_ERROR_PX, CENTER_ERROR_PX, 2)
    return K_found, distortion * (1.0 + rng.uniform(-DISTORTION_ERROR, DISTORTION_ERROR, 5))


def _poses_found(
    truth: Mapping[str, CameraCalibration], intrinsics: Mapping[str, tuple[FloatArray, FloatArray]], seed: int
) -> dict[str, CameraCalibration]:
    """Return every camera with the pose that fits its found intrinsics best.

    Errors drawn for each parameter alone would not do: a calibration minimises what it sees, so an error of the centre
    comes with a rotation that makes up for it, and points near the boards come out far better than either suggests.
    """
    boards = _board_points(seeded(seed, 21))
    poses: dict[str, FloatArray] = {}
    for index, (name, calibration) in enumerate(truth.items()):
        camera = camera_model(calibration)
        noise = seeded(seed, 22, index, zlib.crc32(name.encode())).normal(0.0, CORNER_SIGMA_PX, (len(boards), 2))
        pixels = camera.project(boards)
        seen = camera.contains(pixels)
        rotation = vector_from_rotation(camera.R_camera_rig)
        _, turn_found, t_found = cv2.solvePnP(
            boards[seen], (pixels + noise)[seen], *intrinsics[name], rotation.copy(), camera.t_camera_rig.copy(), True
        )
        R_found = rotation_from_vector(np.asarray(turn_found, dtype=np.float64).ravel())
        poses[name] = inverse(rigid(R_found, np.asarray(t_found, dtype=np.float64).ravel()))
    # The rig frame that a calibration defines is its own reference camera, small rotation and all.
    T_reference_rig = inverse(next(iter(poses.values())))
    return {
        name: camera_entry(
            CameraModel.from_arrays(
                truth[name].width, truth[name].height, *intrinsics[name], T_reference_rig @ T_rig_camera
            )
        )
        for name, T_rig_camera in poses.items()
    }


def _quality(
    truth: Mapping[str, CameraCalibration], found: Mapping[str, CameraCalibration], seed: int
) -> dict[str, Any]:
    """Return what a calibration states of itself, measured here with the truth: covariances are built upon it.

    Per pair with the reference camera the epipolar error of the boards' corners; per distance the median error of
    points that the true cameras see and the found ones triangulate.
    """
    cameras = [tuple(camera_model(file[name]) for file in (truth, found)) for name in truth]
    (reference, reference_found), others = cameras[0], cameras[1:]
    boards = _board_points(seeded(seed, 21))
    noise = seeded(seed, 23).normal(0.0, CORNER_SIGMA_PX, (len(cameras), len(boards), 2))
    pairs = {}
    for index, (name, (true, camera)) in enumerate(zip(list(truth)[1:], others, strict=True), start=1):
        corners = reference.project(boards) + noise[0], true.project(boards) + noise[index]
        off_px = epipolar_distance(reference_found, camera, *corners)
        pairs[f"{next(iter(truth))}-{name}"] = {"epipolar_rms_px": round(float(np.sqrt(np.mean(off_px**2))), 4)}
    expected = {}
    stated_m = (0.5, 0.75, 1.0)
    for distance_m in stated_m:
        x, y = np.meshgrid(np.linspace(-0.3, 0.3, 9) * distance_m, np.linspace(-0.2, 0.2, 7) * distance_m)
        points = np.column_stack([x.ravel(), y.ravel(), np.full(x.size, distance_m)])
        errors = []
        for true, camera in others:
            pixels = reference.project(points), true.project(points)
            seen = reference.contains(pixels[0]) & true.contains(pixels[1])
            if seen.any():
                uv = [one[seen] for one in pixels]
                found_at = meeting_points((reference_found, camera), uv, np.ones((2, len(uv[0])), dtype=bool))
                errors.append(np.linalg.norm(found_at - points[seen], axis=1))
        if errors:
            expected[f"{100 * distance_m:.0f} cm"] = {
                "calibration": round(1e3 * float(np.median(np.concatenate(errors))), 3)
            }
    return {"pairs": pairs, "expected_error_mm": expected}


def _board_points(rng: np.random.Generator) -> FloatArray:
    """Return corners (N, 3) of a chessboard held at many positions above the desk, metres, rig frame."""
    board_size = (9, 6)
    columns, rows = board_size
    x, y = np.meshgrid(np.arange(columns) - (columns - 1) / 2, np.arange(rows) - (rows - 1) / 2)
    board_square_m = 0.025
    board = board_square_m * np.column_stack([x.ravel(), y.ravel(), np.zeros(x.size)])
    views = []
    board_views = 20
    for _ in range(board_views):
        position = rng.uniform((-0.15, -0.12, 0.5), (0.2, 0.12, 0.9))
        views.append(board @ rotation_from_vector(rng.uniform(-0.5, 0.5, 3)).T + position)
    return np.concatenate(views)


def _intrinsics(camera: CameraConfig, rng: np.random.Generator) -> FloatArray:
    focal = 0.5 * camera.width / float(np.tan(np.radians(camera.fov_deg) / 2.0)) * rng.uniform(0.99, 1.01)
    K = np.eye(3)
    K[0, 0], K[1, 1] = focal, focal * rng.uniform(0.999, 1.001)
    K[:2, 2] = np.array([camera.width - 1.0, camera.height - 1.0]) / 2.0 + rng.uniform(-4.0, 4.0, 2)
    return K


def _pose(index: int, rng: np.random.Generator) -> FloatArray:
    T = np.eye(4)
    if index == 0:
        return T
    if index == 1:
        T[:3, :3] = rotation_from_vector(np.radians(rng.uniform(-1.0, 1.0, 3)))
        T[:3, 3] = np.array([BASELINE_M, 0.0, 0.0]) + rng.uniform(-0.001, 0.001, 3)
        return T
    # A ring about the reference, at 0.25 to 0.4 m: turned by the golden angle, no two cameras come to stand together.
    angle = np.radians(137.5) * (index - 2) + np.pi
    reach = rng.uniform(0.25, 0.40)
    T[:3, 3] = reach * np.cos(angle), 0.7 * reach * np.sin(angle), rng.uniform(0.0, 0.05)
    forward = np.array([0.0, 0.0, FOCUS_Z_M]) - T[:3, 3]
    forward /= np.linalg.norm(forward)
    right = np.cross([0.0, 1.0, 0.0], forward)
    right /= np.linalg.norm(right)
    T[:3, :3] = np.column_stack([right, np.cross(forward, right), forward])
    return T
