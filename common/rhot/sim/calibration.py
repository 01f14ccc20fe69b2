"""The true geometry of simulated cameras, and what a calibration would have found of it."""

from __future__ import annotations

import zlib
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from rhot.rig.calibration import CameraCalibration, CamerasFile, Matrix3, Matrix4, today
from rhot.rig.config import CameraConfig
from rhot.rotations import rotation_from_vector
from rhot.sim.script import seeded

FloatArray = NDArray[np.float64]

BASELINE_M: Final = 0.075
"""Distance of the second camera, to the right of the first."""
DISTORTION: Final = (0.16, -0.36, 0.0006, -0.0004, 0.18)
"""k1, k2, p1, p2, k3 of a Raspberry Pi camera's lens, about."""
FOCUS_Z_M: Final = 0.82
"""Further cameras look at the middle of where hands are, this far in front of the first."""

FOCAL_ERROR: Final = 0.002
CENTER_ERROR_PX: Final = 0.5
ROTATION_ERROR_RAD: Final = float(np.radians(0.05))
TRANSLATION_ERROR_M: Final = 0.0003
"""Largest errors of the simulated calibration, each evenly drawn within its bounds."""


@dataclass(frozen=True, slots=True)
class SimulatedCalibration:
    """Geometry of the simulated cameras.

    Attributes:
        truth: what the pictures are rendered with.
        found: the same with a calibration's errors: what the tracker works with.
    """

    truth: CamerasFile
    found: CamerasFile


def simulated_rig_calibration(cameras: Mapping[str, CameraConfig], seed: int) -> SimulatedCalibration:
    """Return true and found geometry of a rig's cameras.

    The first camera is the reference and defines the rig frame; the second stands 75 mm to its right and is turned by
    about 1°; further ones stand around and look at where hands are. A camera's geometry follows from the seed, its
    name and its place alone.

    Args:
        cameras: by name, in the order of `rig.toml`.
        seed: of the world.
    """
    truth: dict[str, CameraCalibration] = {}
    found: dict[str, CameraCalibration] = {}
    for place, (name, camera) in enumerate(cameras.items()):
        rng = seeded(seed, 20, place, zlib.crc32(name.encode()))
        K = _intrinsics(camera, rng)
        distortion = np.array(DISTORTION) * rng.uniform(0.85, 1.15, 5)
        T = _pose(place, rng)
        truth[name] = _calibration(camera, K, distortion, T)
        K_found = K.copy()
        K_found[[0, 1], [0, 1]] *= 1.0 + rng.uniform(-FOCAL_ERROR, FOCAL_ERROR)
        K_found[:2, 2] += rng.uniform(-CENTER_ERROR_PX, CENTER_ERROR_PX, 2)
        T_found = T.copy()
        if place > 0:
            # Each component within bound / √3, so that the whole stays within the bound.
            turn = rng.uniform(-1.0, 1.0, 3) * (ROTATION_ERROR_RAD / np.sqrt(3.0))
            T_found[:3, :3] = T[:3, :3] @ rotation_from_vector(turn)
            T_found[:3, 3] += rng.uniform(-1.0, 1.0, 3) * (TRANSLATION_ERROR_M / np.sqrt(3.0))
        found[name] = _calibration(camera, K_found, distortion * (1.0 + rng.uniform(-0.02, 0.02, 5)), T_found)
    note = {"source": "simulated", "seed": seed}
    return SimulatedCalibration(
        truth=CamerasFile(date=today(), quality={**note, "errors": "none"}, cameras=truth),
        found=CamerasFile(date=today(), quality={**note, "errors": "as of a calibration"}, cameras=found),
    )


def _intrinsics(camera: CameraConfig, rng: np.random.Generator) -> FloatArray:
    focal = 0.5 * camera.width / float(np.tan(np.radians(camera.fov_deg) / 2.0)) * rng.uniform(0.99, 1.01)
    K = np.eye(3)
    K[0, 0], K[1, 1] = focal, focal * rng.uniform(0.999, 1.001)
    K[:2, 2] = np.array([camera.width - 1.0, camera.height - 1.0]) / 2.0 + rng.uniform(-4.0, 4.0, 2)
    return K


def _pose(place: int, rng: np.random.Generator) -> FloatArray:
    T = np.eye(4)
    if place == 0:
        return T
    if place == 1:
        T[:3, :3] = rotation_from_vector(np.radians(rng.uniform(-1.0, 1.0, 3)))
        T[:3, 3] = np.array([BASELINE_M, 0.0, 0.0]) + rng.uniform(-0.001, 0.001, 3)
        return T
    # A ring about the reference, at 0.25 to 0.4 m: turned by the golden angle, no two cameras come to stand together.
    angle = np.radians(137.5) * (place - 2) + np.pi
    reach = rng.uniform(0.25, 0.40)
    T[:3, 3] = reach * np.cos(angle), 0.7 * reach * np.sin(angle), rng.uniform(0.0, 0.05)
    forward = np.array([0.0, 0.0, FOCUS_Z_M]) - T[:3, 3]
    forward /= np.linalg.norm(forward)
    right = np.cross([0.0, 1.0, 0.0], forward)
    right /= np.linalg.norm(right)
    T[:3, :3] = np.column_stack([right, np.cross(forward, right), forward])
    return T


def _calibration(camera: CameraConfig, K: FloatArray, distortion: FloatArray, T: FloatArray) -> CameraCalibration:
    k1, k2, p1, p2, k3 = (float(value) for value in distortion)
    return CameraCalibration(
        width=camera.width,
        height=camera.height,
        K=_matrix3(K),
        distortion=(k1, k2, p1, p2, k3),
        T_rig_camera=_matrix4(T),
    )


def _matrix3(M: FloatArray) -> Matrix3:
    a, b, c = ((float(row[0]), float(row[1]), float(row[2])) for row in M)
    return a, b, c


def _matrix4(M: FloatArray) -> Matrix4:
    a, b, c, d = ((float(row[0]), float(row[1]), float(row[2]), float(row[3])) for row in M)
    return a, b, c, d
