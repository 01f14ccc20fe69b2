"""The family of random rigs: cameras as somebody might have set them up, and as a calibration would have found them.

Found lenses differ from the true ones by what the calibration's own figures state; the poses are then those that fit
chessboard corners best, so that errors hide one another as those of a real calibration do.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import cv2
import numpy as np

from rhot.camera import CameraModel
from rhot.rig import HandFile, Rig, load_rig, write_json_model
from rhot.rig.calibration import CamerasFile, today
from rhot.rig.folder import CAMERAS_FILE, HAND_FILE, RIG_FILE, write_text_atomic
from rhot.rig.template import rig_template
from rhot.rig.toml_edit import change_rig_file
from rhot.rotations import rotation_from_vector, rotation_z, vector_from_rotation
from rhot.transforms import inverse, rigid
from rhot_bench.motion.recordings import FloatArray

CAMERA_NAMES: Final = ("left", "right", "third", "fourth")
WIDTH, HEIGHT = 640, 480
_BOARD_VIEWS: Final = 20


@dataclass(frozen=True, slots=True)
class Family:
    """Bounds from which rigs are drawn, as issue 12 states them; what it leaves open is chosen as rigs are built.

    Attributes:
        rate_hz: frames per second, log-uniform.
        baseline_m: distance of the first two cameras.
        distance_m: of the hand.
        readout_s, exposure_s: of all cameras of a rig, cut so that they fit into the frame period.
        noise_px: standard deviation of a marker's centre, each axis, log-uniform.
        lost: share of frames lost, each for itself.
        cameras: how many, with the chances of each.
        fov_deg: horizontal field of view; Pi cameras have 54 to 66.
        parallel: chance that cameras look straight ahead; else they are toed in at the hand, give or take.
        lens_sd: relative standard error of the focal length, and of the centre in pixels: calibrations with `rhot
            calibrate cameras` state 0.0005 to 0.002 and 0.2 to 1 px.
        corner_px: noise of the chessboard corners that poses are fitted to; such calibrations state 0.05 to 0.3 px.
    """

    rate_hz: tuple[float, float] = (15.0, 120.0)
    baseline_m: tuple[float, float] = (0.060, 0.200)
    distance_m: tuple[float, float] = (0.50, 1.10)
    readout_s: tuple[float, float] = (0.0, 0.016)
    exposure_s: tuple[float, float] = (0.001, 0.008)
    noise_px: tuple[float, float] = (0.05, 0.5)
    lost: tuple[float, float] = (0.0, 0.20)
    cameras: tuple[tuple[int, float], ...] = ((2, 0.6), (3, 0.25), (4, 0.15))
    fov_deg: tuple[float, float] = (54.0, 68.0)
    parallel: float = 0.5
    lens_sd: tuple[tuple[float, float], tuple[float, float]] = ((0.0005, 0.002), (0.2, 1.0))
    corner_px: tuple[float, float] = (0.05, 0.3)


@dataclass(frozen=True, slots=True)
class RigDraw:
    """One rig of the family.

    Attributes:
        rate_hz, noise_px, lost, readout_s, exposure_s: of all cameras.
        phases: (C,) start of each camera's frames, as a share of the period.
        distance_m: of the hand from the first camera, along its axis.
        true, found: cameras by name, as they are and as `cameras.json` has them; the first is the rig frame of both.
        quality: of `cameras.json`.
    """

    rate_hz: float
    noise_px: float
    lost: float
    readout_s: float
    exposure_s: float
    phases: FloatArray
    distance_m: float
    true: Mapping[str, CameraModel]
    found: Mapping[str, CameraModel]
    quality: dict[str, Any]

    def describe(self) -> str:
        """Return the rig in one line, for people."""
        centres = [camera.center for camera in self.true.values()]
        return (
            f"{len(self.true)} cameras at {self.rate_hz:.0f} fps, {1e3 * np.linalg.norm(centres[1]):.0f} mm apart, "
            f"{100 * self.distance_m:.0f} cm away, read-out {1e3 * self.readout_s:.0f} ms, "
            f"exposure {1e3 * self.exposure_s:.0f} ms, {self.noise_px:.2f} px, {100 * self.lost:.0f} % lost"
        )


def draw_rig(
    rng: np.random.Generator, family: Family, rate_hz: float | None = None, noise_px: float | None = None
) -> RigDraw:
    """Draw a rig; a given rate or noise replaces the drawn one and changes nothing else."""
    drawn_hz, drawn_px = _log_uniform(rng, family.rate_hz), _log_uniform(rng, family.noise_px)
    rate, noise = rate_hz or drawn_hz, drawn_px if noise_px is None else noise_px
    counts, chances = zip(*family.cameras, strict=True)
    count = int(rng.choice(counts, p=chances))
    distance = float(rng.uniform(*family.distance_m))
    readout = min(float(rng.uniform(*family.readout_s)), 0.95 / rate)
    exposure = min(float(rng.uniform(*family.exposure_s)), 0.9 / rate)
    lost = float(rng.uniform(*family.lost))
    phases = rng.uniform(0.0, 1.0, count)
    toed_in = rng.random() >= family.parallel
    baseline = float(rng.uniform(*family.baseline_m))
    target = np.array([0.5 * baseline, 0.0, distance])
    true = {}
    for number, name in enumerate(CAMERA_NAMES[:count]):
        T = _pose(rng, number, baseline, target if toed_in else None)
        focal = 0.5 * WIDTH / np.tan(np.radians(rng.uniform(*family.fov_deg)) / 2.0)
        K = np.array([[focal, 0.0, WIDTH / 2.0 - 0.5], [0.0, focal * rng.uniform(0.998, 1.002), HEIGHT / 2.0 - 0.5]])
        K[:, 2] += rng.uniform(-8.0, 8.0, 2)
        bend = rng.uniform(-0.08, 0.16)
        distortion = np.array([bend, -2.0 * bend * abs(bend), *rng.uniform(-7e-4, 7e-4, 2), 0.0])
        true[name] = CameraModel.from_arrays(WIDTH, HEIGHT, np.vstack([K, [0.0, 0.0, 1.0]]), distortion, T)
    # In a parallel rig the hand is held where both cameras see it.
    found, quality = _calibrated(rng, family, true, target)
    return RigDraw(rate, noise, lost, readout, exposure, phases, distance, true, found, quality)


def write_rig(draw: RigDraw, folder: Path, hand: HandFile, patch_m: tuple[float, float]) -> Rig:
    """Write the rig's folder, as a person and `rhot calibrate` would have, and return it loaded."""
    folder.mkdir(parents=True, exist_ok=True)
    text = rig_template(
        folder=str(folder),
        name="family",
        cameras=tuple(draw.true),
        camera_xs_m=[float(camera.center[0]) for camera in draw.found.values()],
        rate_hz=round(draw.rate_hz, 3),
        exposure_s=round(draw.exposure_s, 6),
        readout_s=round(draw.readout_s, 6),
        length_m=hand.length_m,
    )
    write_text_atomic(folder / RIG_FILE, text)
    change_rig_file(folder, {("markers", "base"): {"size_m": [round(size, 4) for size in patch_m]}})
    cameras = {name: camera.to_calibration() for name, camera in draw.found.items()}
    write_json_model(folder / CAMERAS_FILE, CamerasFile(date=today(), cameras=cameras, quality=draw.quality))
    write_json_model(folder / HAND_FILE, hand)
    return load_rig(folder)


def _log_uniform(rng: np.random.Generator, bounds: tuple[float, float]) -> float:
    return float(np.exp(rng.uniform(np.log(bounds[0]), np.log(bounds[1]))))


def _pose(rng: np.random.Generator, number: int, baseline: float, target: FloatArray | None) -> FloatArray:
    """Return T_rig_camera (4, 4); the first camera is the rig frame."""
    off_rad = np.radians(rng.uniform(-1.5, 1.5, 3))
    reach, angle = float(rng.uniform(0.06, 0.20)), float(rng.uniform(0.35, 2.8))
    if number == 0:
        return np.eye(4)
    aside = np.array([baseline, 0.0, 0.0]) + rng.uniform(-0.006, 0.006, 3)
    if number > 1:
        # Further cameras stand above and below the line of the first two.
        angle = angle if number == 2 else -angle
        aside = np.array([0.5 * baseline + reach * np.cos(angle), reach * np.sin(angle), rng.uniform(-0.02, 0.02)])
    if target is None:
        return rigid(rotation_from_vector(off_rad), aside)
    # The first camera looks straight ahead, so the others turn to where its axis meets the hand.
    forward = np.array([0.0, 0.0, target[2]]) - aside
    forward /= np.linalg.norm(forward)
    right = np.cross([0.0, 1.0, 0.0], forward)
    right /= np.linalg.norm(right)
    R = np.column_stack([right, np.cross(forward, right), forward])
    return rigid(R @ rotation_z(float(off_rad[2])) @ rotation_from_vector(off_rad * [1.0, 1.0, 0.0]), aside)


def _calibrated(
    rng: np.random.Generator, family: Family, true: Mapping[str, CameraModel], target: FloatArray
) -> tuple[dict[str, CameraModel], dict[str, Any]]:
    """Return the cameras as found, and the quality figures that `rhot calibrate cameras` would state."""
    corner_px = _log_uniform(rng, family.corner_px)
    focal_sd, centre_sd = (_log_uniform(rng, bounds) for bounds in family.lens_sd)
    boards = _board_corners(rng, target)
    lenses, poses, figures = {}, {}, {}
    for name, camera in true.items():
        K = camera.K.copy()
        K[[0, 1], [0, 1]] *= 1.0 + focal_sd * rng.standard_normal()
        K[:2, 2] += centre_sd * rng.standard_normal(2)
        distortion = camera.distortion * (1.0 + 0.02 * rng.standard_normal(5))
        pixels = camera.project(boards)
        seen = camera.contains(pixels)
        noisy = pixels[seen] + rng.normal(0.0, corner_px, (int(seen.sum()), 2))
        start = vector_from_rotation(camera.R_camera_rig), camera.t_camera_rig.copy()
        _, turn, t = cv2.solvePnP(boards[seen], noisy, K, distortion, *start, True)
        poses[name] = inverse(rigid(rotation_from_vector(np.asarray(turn, dtype=np.float64).ravel()), np.ravel(t)))
        lenses[name] = (K, distortion)
        off = CameraModel.from_arrays(WIDTH, HEIGHT, K, distortion, poses[name]).project(boards[seen]) - noisy
        size = np.linalg.norm(off, axis=1)
        figures[name] = {
            "rms_px": round(float(np.sqrt((size**2).mean())), 4),
            "p95_px": round(float(np.percentile(size, 95)), 4),
            "lens_sd": {"fx": round(focal_sd * K[0, 0], 3), "cx": round(centre_sd, 3), "cy": round(centre_sd, 3)},
        }
    T_reference = inverse(next(iter(poses.values())))
    found = {
        name: CameraModel.from_arrays(WIDTH, HEIGHT, *lenses[name], T_reference @ pose) for name, pose in poses.items()
    }
    quality = {
        "source": "a family of random rigs",
        "rms_px": round(float(np.sqrt(np.mean([one["rms_px"] ** 2 for one in figures.values()]))), 4),
        "cameras": figures,
        "pairs": {
            f"{first}-{second}": _pair_figures(true, found, first, second, boards, corner_px, rng)
            for place, first in enumerate(found)
            for second in list(found)[place + 1 :]
        },
    }
    return found, quality


def _pair_figures(
    true: Mapping[str, CameraModel],
    found: Mapping[str, CameraModel],
    first: str,
    second: str,
    boards: FloatArray,
    corner_px: float,
    rng: np.random.Generator,
) -> dict[str, float]:
    """Return how far the rows of two views disagree at the chessboards' corners, pixels."""
    pixels = [true[name].project(boards) for name in (first, second)]
    both = true[first].contains(pixels[0]) & true[second].contains(pixels[1])
    a, b = (uv[both] + rng.normal(0.0, corner_px, (int(both.sum()), 2)) for uv in pixels)
    one, other = found[first], found[second]
    R = other.R_camera_rig @ one.R_camera_rig.T
    t = other.to_camera(one.center[None])[0]
    rays = np.column_stack([one.undistort(a), np.ones(len(a))]) @ R.T
    lines = np.cross(t, rays)
    xy = np.column_stack([other.undistort(b), np.ones(len(b))])
    off = (lines * xy).sum(axis=1) / np.linalg.norm(lines[:, :2], axis=1) * float(other.K[0, 0])
    baseline = float(np.linalg.norm(one.center - other.center))
    return {
        "baseline_mm": round(1e3 * baseline, 3),
        "epipolar_rms_px": round(float(np.sqrt((off**2).mean())), 4),
        "epipolar_p95_px": round(float(np.percentile(np.abs(off), 95)), 4),
    }


def _board_corners(rng: np.random.Generator, target: FloatArray) -> FloatArray:
    """Return corners (N, 3) of a chessboard held at many places about where the hand will be, metres."""
    x, y = np.meshgrid(np.arange(9) - 4.0, np.arange(6) - 2.5)
    board = 0.025 * np.column_stack([x.ravel(), y.ravel(), np.zeros(x.size)])
    views = []
    for _ in range(_BOARD_VIEWS):
        place = target + rng.uniform((-0.2, -0.15, -0.15), (0.2, 0.15, 0.15)) * target[2] / 0.8
        views.append(board @ rotation_from_vector(rng.uniform(-0.5, 0.5, 3)).T + place)
    return np.concatenate(views)
