"""What simulated cameras see of a board: corners with noise, and the truth behind them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from rhot.arrays import FloatArray
from rhot.geometry.camera import CameraModel
from rhot.geometry.rotations import rotation_from_vector
from rhot.rig.cameras import camera_model
from rhot.rig.config import CameraConfig
from rhot_calibration.cameras.solve.views import Board, BoardView, ViewSet
from rhot_sim.rig.calibration import simulated_rig_calibration

CAMERAS = ("left", "right", "third", "fourth", "fifth", "sixth", "seventh", "eighth")
BOARD = Board(9, 6, 0.025)


@dataclass(frozen=True, slots=True)
class SimulatedViews:
    """Views of a board and the cameras that had them."""

    views: ViewSet
    cameras: dict[str, CameraModel]


def simulated_views(
    seed: int, cameras: int = 2, places: int = 30, noise_px: float = 0.1, board: Board = BOARD, bow_m: float = 0.0
) -> SimulatedViews:
    """Return corners of a board held at random places above the desk, seen by the cameras of a simulated rig.

    Args:
        seed: of everything.
        cameras: how many, 2 to 8.
        places: at which the board is held; each is seen by two cameras or more.
        noise_px: standard deviation of a corner's coordinates.
        board: what is shown.
        bow_m: how far the middle of the board stands out.
    """
    names = CAMERAS[:cameras]
    truth = simulated_rig_calibration({name: CameraConfig() for name in names}, seed).truth.cameras
    models = {name: camera_model(truth[name]) for name in names}
    rng = np.random.default_rng([seed, cameras])
    points = board.points - board.points.mean(axis=0)
    reach = np.linalg.norm(points, axis=1).max()
    points[:, 2] = bow_m * (1.0 - (np.linalg.norm(points, axis=1) / reach) ** 2)
    views: dict[tuple[str, int], BoardView] = {}
    number = 0
    for _ in range(200 * places):
        if number == places:
            break
        center = rng.uniform((-0.28, -0.22, 0.35), (0.32, 0.22, 0.95))
        R = rotation_from_vector(np.append(rng.uniform(-0.6, 0.6, 2), rng.uniform(-0.5, 0.5)))
        placed = points @ R.T + center
        seen = {}
        for name, model in models.items():
            facing = (center - model.center) @ R[:, 2] > 0.2 * float(np.linalg.norm(center - model.center))
            uv = model.project(placed)
            if facing and model.contains(uv).all():
                seen[name] = BoardView(np.arange(len(uv)), uv + noise_px * rng.standard_normal(uv.shape))
        if len(seen) >= 2:
            number += 1
            views |= {(name, number): view for name, view in seen.items()}
    labels = {key: f"{key[0]}/{key[1]:06d}.png" for key in views}
    sizes = {name: (model.width, model.height) for name, model in models.items()}
    return SimulatedViews(ViewSet(board, sizes, views, labels), models)


def nominal_lens(width: int = 640, height: int = 480, fov_deg: float = 62.2) -> FloatArray:
    """Return the lens (9,) that a calibration starts from."""
    focal = 0.5 * width / np.tan(np.radians(fov_deg) / 2.0)
    return np.array([focal, focal, (width - 1) / 2, (height - 1) / 2, 0, 0, 0, 0, 0], dtype=np.float64)
