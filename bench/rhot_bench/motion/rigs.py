"""The family of random rigs: cameras as somebody might have set them up, and as a calibration would have found them.

The cameras are calibrated by the very adjustment of `rhot calibrate cameras`, on noisy corners of a chessboard that is
held where the hand will be; it starts at the truth, which spares the search and ends in the same minimum. So
`cameras.json` is wrong by as much as its own figures state, and its errors hide one another as those of a real
calibration do.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Final

import numpy as np

from rhot.arrays import FloatArray
from rhot.geometry.camera import CameraModel
from rhot.geometry.rotations import inverse, rigid, rotation_from_vector, rotation_z
from rhot.rig import CamerasFile, HandFile, Rig, load_rig, write_json_model
from rhot.rig.folder import CAMERAS_FILE, HAND_FILE, RIG_FILE, write_text_atomic
from rhot.rig.template import rig_template
from rhot.rig.toml_edit import change_rig_file
from rhot_calibration.cameras.bundle.adjustment import adjust_views
from rhot_calibration.cameras.bundle.lens import lens_of
from rhot_calibration.cameras.calibration import Calibrated, cameras_file, models_of
from rhot_calibration.cameras.figures import camera_figures, expected_errors, pair_figures
from rhot_calibration.cameras.solve.solve import Solution
from rhot_calibration.cameras.solve.views import Board, BoardView, ViewSet

CAMERA_NAMES: Final = ("left", "right", "third", "fourth")
WIDTH, HEIGHT = 640, 480
_BOARD: Final = Board(9, 6, 0.025)


@dataclass(frozen=True, slots=True)
class Family:
    """Bounds from which rigs are drawn, chosen as rigs are built and set before the tracker was measured on them.

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
        boards: pictures of a chessboard that the cameras are calibrated with; the README asks for 20 to 40.
        corner_px: noise of its corners, each axis; the RMS that `rhot calibrate cameras` states is 1.4 times that, and
            was 0.07 px on the rendered pictures, 0.10 to 0.15 px on printed boards.
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
    boards: tuple[int, int] = (20, 40)
    corner_px: tuple[float, float] = (0.04, 0.10)


@dataclass(frozen=True, slots=True)
class RigDraw:
    """One rig of the family.

    Attributes:
        rate_hz, noise_px, lost, readout_s, exposure_s: of all cameras.
        phases: (C,) start of each camera's frames, as a share of the period.
        distance_m: of the hand from the first camera, along its axis.
        true: cameras by name, as they are; the first one's frame is the rig frame.
        found: `cameras.json`, with its quality figures.
    """

    rate_hz: float
    noise_px: float
    lost: float
    readout_s: float
    exposure_s: float
    phases: FloatArray
    distance_m: float
    true: Mapping[str, CameraModel]
    found: CamerasFile

    def describe(self) -> str:
        """Return the rig in one line, for people."""
        centres = [camera.center for camera in self.true.values()]
        return (
            f"{len(self.true)} cameras at {self.rate_hz:.0f} fps, {1e3 * np.linalg.norm(centres[1]):.0f} mm apart, "
            f"{100 * self.distance_m:.0f} cm away, read-out {1e3 * self.readout_s:.0f} ms, "
            f"exposure {1e3 * self.exposure_s:.0f} ms, {self.noise_px:.2f} px, {100 * self.lost:.0f} % lost"
        )


def draw_rig(seed: int, family: Family, rate_hz: float | None = None, noise_px: float | None = None) -> RigDraw:
    """Draw a rig; a given rate or noise replaces the drawn one and changes nothing else."""
    geometry = _geometry(seed, family)
    rng = np.random.default_rng([13, seed])
    drawn_hz, drawn_px = _log_uniform(rng, family.rate_hz), _log_uniform(rng, family.noise_px)
    rate, noise = rate_hz or drawn_hz, drawn_px if noise_px is None else noise_px
    return RigDraw(
        rate_hz=rate,
        noise_px=noise,
        lost=float(rng.uniform(*family.lost)),
        readout_s=min(float(rng.uniform(*family.readout_s)), 0.95 / rate),
        exposure_s=min(float(rng.uniform(*family.exposure_s)), 0.9 / rate),
        phases=rng.uniform(0.0, 1.0, len(geometry.true)),
        distance_m=geometry.distance_m,
        true=geometry.true,
        found=geometry.found,
    )


@dataclass(frozen=True, slots=True)
class _Geometry:
    distance_m: float
    true: dict[str, CameraModel]
    found: CamerasFile


@lru_cache(maxsize=256)
def _geometry(seed: int, family: Family) -> _Geometry:
    """Draw true cameras and calibrate them; kept, as the same rig is run at several rates."""
    rng = np.random.default_rng([14, seed])
    counts, chances = zip(*family.cameras, strict=True)
    count = int(rng.choice(counts, p=chances))
    distance, baseline = float(rng.uniform(*family.distance_m)), float(rng.uniform(*family.baseline_m))
    toed_in = rng.random() >= family.parallel
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
    return _Geometry(distance, true, _calibrated(rng, family, true, target))


def write_rig(draw: RigDraw, folder: Path, hand: HandFile, patch_m: tuple[float, float]) -> Rig:
    """Write the rig's folder, as a person and `rhot calibrate` would have, and return it loaded."""
    folder.mkdir(parents=True, exist_ok=True)
    text = rig_template(
        folder=str(folder),
        name="family",
        cameras=tuple(draw.true),
        camera_xs_m=[round(float(camera.center[0]), 3) for camera in draw.true.values()],
        rate_hz=round(draw.rate_hz, 3),
        exposure_s=round(draw.exposure_s, 6),
        readout_s=round(draw.readout_s, 6),
        length_m=hand.length_m,
    )
    write_text_atomic(folder / RIG_FILE, text)
    change_rig_file(folder, {("markers", "base"): {"size_m": [round(size, 4) for size in patch_m]}})
    write_json_model(folder / CAMERAS_FILE, draw.found)
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
) -> CamerasFile:
    """Return what `rhot calibrate cameras` would write."""
    corner_px = _log_uniform(rng, family.corner_px)
    poses = _board_poses(rng, true, target, int(rng.integers(*family.boards)))
    views, place_of = {}, {}
    for number, T in enumerate(poses):
        for name, camera in true.items():
            pixels = camera.project(_BOARD.points @ T[:3, :3].T + T[:3, 3])
            if camera.contains(pixels).all():
                noisy = pixels + rng.normal(0.0, corner_px, pixels.shape)
                views[name, number] = BoardView(np.arange(len(pixels)), noisy)
                place_of[name, number] = (number, "")
    adjusted = adjust_views(
        _BOARD,
        views,
        place_of,
        {name: lens_of(camera.K, camera.distortion) for name, camera in true.items()},
        {name: inverse(camera.T_rig_camera) for name, camera in true.items()},
        {(number, ""): T for number, T in enumerate(poses)},
        dict.fromkeys(true, WIDTH),
        sigma_px=corner_px,
    )
    labels = {key: f"{key[0]}/{key[1]:06d}.png" for key in views}
    seen = ViewSet(_BOARD, dict.fromkeys(true, (WIDTH, HEIGHT)), views, labels)
    models = models_of(adjusted, seen)
    solution = Solution(views, place_of, adjusted, {}, (), {}, adjusted.total_rms_px(), {})
    pairs, errors = pair_figures(adjusted, models), expected_errors(adjusted, models)
    return cameras_file(Calibrated(solution, models, camera_figures(adjusted), pairs, {}, errors, {}, ()), seen)


def _board_poses(
    rng: np.random.Generator, true: Mapping[str, CameraModel], target: FloatArray, count: int
) -> list[FloatArray]:
    """Return poses (4, 4) of a chessboard, T_rig_board, held at many places that all cameras see whole."""
    middle = _BOARD.points.mean(axis=0)
    poses: list[FloatArray] = []
    for attempt in range(200 * count):
        if len(poses) == count:
            break
        spread = np.array([0.30, 0.22, 0.25]) * target[2]
        R = rotation_from_vector(rng.uniform(-0.6, 0.6, 3))
        T = rigid(R, target + rng.uniform(-spread, spread) - R @ middle)
        corners = _BOARD.points @ R.T + T[:3, 3]
        # Where the views of all cameras hardly overlap, boards that some see whole must do.
        needed = len(true) if attempt < 100 * count else 2
        if sum(bool(camera.contains(camera.project(corners)).all()) for camera in true.values()) >= needed:
            poses.append(T)
    return poses
