"""The floor from boards on a simulated desk: within what the fit says of itself, over seeds and rigs."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from boards.views import BOARD, CAMERAS

from rhot.arrays import FloatArray
from rhot.errors import CalibrationError
from rhot.geometry.camera import CameraModel
from rhot.geometry.rotations import inverse, rigid, rotation_from_vector, rotation_z
from rhot.rig.cameras import camera_models
from rhot.rig.config import CameraConfig, SimConfig
from rhot_calibration.cameras.solve.views import BoardView, ViewSet
from rhot_calibration.stage.desk import SAME_PLANE_M, fit_desk, triangulated
from rhot_calibration.stage.floor import FORWARDS, desk_file, stage_from_desk
from rhot_sim.rig.calibration import simulated_rig_calibration
from rhot_sim.rig.folder import true_stage

SIM = SimConfig()
T_RIG_STAGE = true_stage(SIM)


def desk_views(
    seed: int,
    cameras: int = 2,
    places: int = 3,
    *,
    held: int = 0,
    noise_px: float = 0.1,
) -> tuple[ViewSet, dict[str, CameraModel], dict[str, CameraModel]]:
    """Return corners of boards on the simulated desk and `held` over it, with the found and the true cameras."""
    rng = np.random.default_rng([seed, cameras, 7])
    calibrated = simulated_rig_calibration({name: CameraConfig() for name in CAMERAS[:cameras]}, seed)
    true = camera_models(calibrated.truth.cameras)
    found = camera_models(calibrated.found.cameras)
    points = BOARD.points - BOARD.points.mean(axis=0)
    views = {}
    for number in range(places + held):
        x, y, yaw = rng.uniform((-0.12, -0.10, -0.6), (0.12, 0.10, 0.6))
        T = rigid(rotation_z(yaw), np.array([x, y, SIM.desk_z_m]))
        if number >= places:
            T = T @ rigid(
                rotation_from_vector(rng.uniform(-0.5, 0.5, 3)), np.array([0.0, 0.0, rng.uniform(-0.4, -0.15)])
            )
        for name, camera in true.items():
            uv = camera.project(points @ T[:3, :3].T + T[:3, 3])
            if camera.contains(uv).all():
                views[name, number] = BoardView(np.arange(len(uv)), uv + noise_px * rng.standard_normal(uv.shape))
    sizes = {name: (camera.width, camera.height) for name, camera in true.items()}
    return ViewSet(BOARD, sizes, views, {}), found, true


def height_errors_m(T_rig_stage: FloatArray, found: dict[str, CameraModel], true: dict[str, CameraModel]) -> FloatArray:
    """Return by how much points on the desk and a hand's breadth over it come out too high when they are tracked.

    They are located with the found cameras, as the tracker does it: the rig frame of a calibration is its own.
    """
    x, z = np.meshgrid(np.linspace(-0.15, 0.15, 5), np.linspace(-0.12, 0.12, 5))
    heights = (SIM.desk_height_m, SIM.desk_height_m + 0.1)
    at = np.concatenate([np.column_stack([x.ravel(), np.full(25, y), z.ravel()]) for y in heights])
    shown = at @ T_RIG_STAGE[:3, :3].T + T_RIG_STAGE[:3, 3]
    pixels = {name: camera.project(shown) for name, camera in true.items()}
    T = inverse(T_rig_stage)
    errors = []
    for index, point in enumerate(at):
        rays = [(found[name], uv[index : index + 1]) for name, uv in pixels.items()]
        errors.append((T[:3, :3] @ triangulated(rays) + T[:3, 3])[1] - point[1])
    return np.array(errors)


@pytest.mark.parametrize("cameras", [2, 4])
def test_the_floor_is_found_within_the_stated_residual(cameras: int) -> None:
    """The residual covers what the calibration has wrong: in most rigs heights are better, in none far worse."""
    ratios = []
    for seed in range(8):
        views, found, true = desk_views(seed, cameras)
        fit = fit_desk(found, views)
        assert fit.residual_m is not None
        assert fit.residual_m < 0.006
        T = stage_from_desk(fit, found["left"], SIM.desk_height_m, "down")
        errors = height_errors_m(T, found, true)
        ratios.append(float(np.sqrt((errors**2).mean())) / fit.residual_m)
    assert np.median(ratios) < 1.0, ratios
    assert max(ratios) < 3.0, ratios


def test_one_camera_finds_the_floor_and_does_not_say_how_well() -> None:
    for seed in range(4):
        views, found, _ = desk_views(seed, 1)
        fit = fit_desk(found, views)
        assert fit.residual_m is None
        assert fit.offset_m == pytest.approx(-SIM.desk_z_m, abs=0.01)
        assert fit.up == pytest.approx((0.0, 0.0, -1.0), abs=0.01)


def test_without_noise_it_is_exact() -> None:
    views, _, true = desk_views(3, 2, noise_px=0.0)
    T = stage_from_desk(fit_desk(true, views), true["left"], SIM.desk_height_m, "down")
    np.testing.assert_allclose(T, T_RIG_STAGE, atol=1e-6)


def test_boards_held_in_the_air_are_left_out() -> None:
    views, found, true = desk_views(5, 2, places=3, held=9)
    fit = fit_desk(found, views)
    assert fit.boards == 3
    assert sorted(fit.left_out) == list(range(3, 12))
    T = stage_from_desk(fit, found["left"], SIM.desk_height_m, "down")
    assert np.abs(height_errors_m(T, found, true)).max() < 0.01


def test_boards_that_share_no_plane_are_refused() -> None:
    views, found, _ = desk_views(5, 2, places=1, held=6)
    with pytest.raises(CalibrationError, match="no two of"):
        fit_desk(found, views)


def test_a_board_of_the_wrong_size_is_refused() -> None:
    """A square of 25 mm said to be 30 puts the desk elsewhere for every camera."""
    views, found, _ = desk_views(2, 2)
    with pytest.raises(CalibrationError, match="square-mm"):
        fit_desk(found, replace(views, board=replace(BOARD, square_m=0.030)))


def test_nothing_seen_is_refused() -> None:
    views, found, _ = desk_views(2, 2)
    with pytest.raises(CalibrationError, match="no picture shows the board"):
        fit_desk(found, replace(views, views={}))


@pytest.mark.parametrize("forward", FORWARDS)
def test_forward_is_where_the_picture_says(forward: str) -> None:
    views, found, _ = desk_views(1, 2)
    fit = fit_desk(found, views)
    wanted = {"down": (0, 1), "up": (0, -1), "left": (-1, 0), "right": (1, 0)}[forward]
    T = stage_from_desk(fit, found["left"], 0.74, forward)  # type: ignore[arg-type]
    middle = fit.middle
    ahead = found["left"].project(np.array([middle, middle - 0.05 * T[:3, 2]]))
    step = ahead[1] - ahead[0]
    assert step @ wanted > 0.99 * np.linalg.norm(step)
    assert np.linalg.det(T[:3, :3]) == pytest.approx(1.0)


def test_forward_cannot_be_the_vertical() -> None:
    """With a level camera, `up` in its picture is up in the world."""
    views, _, true = desk_views(1, 1, noise_px=0.0)
    level = replace(fit_desk(true, views), up=np.array([0.0, -1.0, 0.0]))
    with pytest.raises(CalibrationError, match="--forward"):
        stage_from_desk(level, true["left"], 0.74, "up")
    stage_from_desk(level, true["left"], 0.74, "left")


def test_the_file_says_what_it_comes_from() -> None:
    views, found, _ = desk_views(1, 2)
    fit = fit_desk(found, views)
    file = desk_file(fit, found["left"], 0.74, 0.005, "down")
    thin = desk_file(fit, found["left"], 0.74, 0.0, "down")
    lifted = np.array(thin.T_rig_stage.position) - np.array(file.T_rig_stage.position)
    np.testing.assert_allclose(lifted, 0.005 * fit.up, atol=1e-9)
    assert file.source == "desk board"
    assert file.residual_m == pytest.approx(fit.residual_m)
    assert file.desk_height_m == 0.74
    assert file.residual_m is not None
    assert file.residual_m < SAME_PLANE_M
