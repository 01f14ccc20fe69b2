from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from rhot.geometry.rotations import vector_from_rotation
from rhot.rig import CameraConfig
from rhot.rig.cameras import camera_model
from rhot.rig.folder import load_rig
from rhot.rig.toml_edit import change_rig_file
from rhot_sim.rig.calibration import BASELINE_M, SimulatedCalibration, simulated_rig_calibration, true_cameras
from rhot_sim.rig.folder import write_simulated_rig
from rhot_sim.world.world import World

NAMES = ("left", "right", "third", "fourth", "fifth")


def rig(seed: int, count: int = 5) -> SimulatedCalibration:
    return simulated_rig_calibration({name: CameraConfig(source="simulated") for name in NAMES[:count]}, seed)


def test_first_camera_is_the_rig_frame_and_the_second_a_baseline_to_its_right() -> None:
    left, right = (camera_model(rig(1).truth.cameras[name]) for name in ("left", "right"))
    np.testing.assert_array_equal(left.T_rig_camera, np.eye(4))
    np.testing.assert_allclose(right.center, [BASELINE_M, 0.0, 0.0], atol=0.0011)
    turn_deg = np.degrees(np.linalg.norm(vector_from_rotation(right.R_camera_rig)))
    assert 0.05 < turn_deg < 1.8


@pytest.mark.parametrize("seed", range(5))
def test_found_differs_from_true_as_a_calibration_would(seed: int) -> None:
    pair = rig(seed)
    for name in NAMES:
        true, found = (camera_model(file.cameras[name]) for file in (pair.truth, pair.found))
        assert 0.0 < abs(found.K[0, 0] / true.K[0, 0] - 1.0) <= 0.002
        assert 0.0 < np.abs(found.K[:2, 2] - true.K[:2, 2]).max() <= 0.5
        turn_deg = np.degrees(np.linalg.norm(vector_from_rotation(found.R_camera_rig @ true.R_camera_rig.T)))
        assert turn_deg <= 0.2
        assert np.linalg.norm(found.center - true.center) <= 0.003
    np.testing.assert_allclose(camera_model(pair.found.cameras["left"]).T_rig_camera, np.eye(4), atol=1e-9)


@pytest.mark.parametrize("seed", range(5))
def test_points_come_out_as_after_a_good_calibration(seed: int) -> None:
    """Rays of the found cameras through what the true ones see: depth within 4 mm, 1.5 mm sideways, at 0.6 to 0.9 m."""
    pair = rig(seed, 2)
    points = np.random.default_rng(seed).uniform((-0.15, -0.12, 0.6), (0.15, 0.12, 0.9), (200, 3))
    origins, rays = [], []
    for name in ("left", "right"):
        found = camera_model(pair.found.cameras[name])
        rays.append(found.rays(camera_model(pair.truth.cameras[name]).project(points)))
        origins.append(found.center)
    across = np.einsum("ni,ni->n", rays[0], rays[1])
    base = origins[1] - origins[0]
    along = (rays[0] @ base - across * (rays[1] @ base)) / (1.0 - across**2)
    error = origins[0] + along[:, None] * rays[0] - points
    assert np.abs(np.median(error[:, 2])) < 0.004
    assert np.abs(np.median(error[:, :2], axis=0)).max() < 0.0015
    assert np.abs(error).max() > 1e-5, "a calibration without any error would be no test of the tracker"


def test_seed_decides() -> None:
    assert rig(3).truth.cameras == rig(3).truth.cameras
    assert rig(3).found.cameras != rig(4).found.cameras


def test_cameras_stay_where_they_were_calibrated_when_the_world_gets_another_seed(tmp_path: Path) -> None:
    before = write_simulated_rig(tmp_path / "rig", seed=1)
    change_rig_file(before.path, {("sim",): {"seed": 2}})
    after = load_rig(before.path)
    assert after.config.sim.seed == 2
    assert {name: camera.center.tolist() for name, camera in true_cameras(after).items()} == {
        name: camera.center.tolist() for name, camera in true_cameras(before).items()
    }


def test_a_camera_does_not_depend_on_those_after_it() -> None:
    assert rig(3, 2).truth.cameras["right"] == rig(3, 5).truth.cameras["right"]


def test_all_cameras_see_the_hand(world: World) -> None:
    sample = world.sample(np.arange(0.0, 32.0, 0.25))
    points = np.concatenate(list(sample.markers.values()))
    for calibration in rig(1).truth.cameras.values():
        camera = camera_model(calibration)
        assert camera.contains(camera.project(points)).mean() > 0.98


@pytest.mark.parametrize("seed", range(5))
def test_what_it_states_of_itself_is_what_it_has(seed: int) -> None:
    """Covariances of points are built upon these figures: without them the tracker assumes 0.2 px, too much."""
    quality = rig(seed).found.quality
    stated_mm = [quality["expected_error_mm"][f"{cm} cm"]["calibration"] for cm in (50, 75, 100)]
    assert all(0.1 < stated < 4.0 for stated in stated_mm)
    assert set(quality["pairs"]) == {f"left-{name}" for name in NAMES[1:]}
    # Corners with 0.1 px of noise in either view, and what the lenses are off by.
    assert 0.1 <= quality["pairs"]["left-right"]["epipolar_rms_px"] < 0.5
