"""Static markers in simulated pictures: found where their visible paint truly is."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from rhot.geometry.camera import CameraModel
from rhot.rig import Rig, load_rig
from rhot.rig.colors import nominal_colors
from rhot_capture.detection.color_table import build_color_table
from rhot_capture.detection.detector import MarkerDetector
from rhot_sim.rendering.coverage import MarkerCoverage
from rhot_sim.rendering.renderer import Renderer
from rhot_sim.rig.calibration import true_cameras
from rhot_sim.world.paint import paints_of
from rhot_sim.world.world import World

CAMERAS = ("left", "right")


def still_rig(write_rig: Callable[..., Path], noise_sigma: float) -> Rig:
    cameras = dict.fromkeys(CAMERAS, 'source = "simulated"\n')
    sim = f"[sim]\nmotion = 'still'\nnoise_sigma = {noise_sigma}\nlight_drift = 0.0\n"
    return load_rig(write_rig(cameras, sim))


def errors_px(rig: Rig, camera: str, model: CameraModel, frames: int) -> dict[str, NDArray[np.float64]]:
    """Return per marker the distance (frames,) of its found from its true centre, pixels."""
    world = World.from_rig(rig)
    place = list(rig.config.cameras).index(camera)
    renderer = Renderer(model, world, rig.config.sim, rig.config.cameras[camera], place)
    names = list(rig.config.markers)
    colors = nominal_colors({name: (red, green, blue) for name, (blue, green, red) in paints_of(names).items()})
    detector = MarkerDetector(rig.config.markers, build_color_table(colors, names), model.width, model.height)
    true = MarkerCoverage(model, world, scale=8, vertices=64).at(0.0)
    found = [detector.detect(renderer.render(frame / 60.0, readout_s=0.0)) for frame in range(frames)]
    assert all(set(each) == set(names) for each in found)
    return {
        name: np.array([np.hypot(each[name].u - true[name].u, each[name].v - true[name].v) for each in found])
        for name in names
    }


@pytest.mark.parametrize("camera", CAMERAS)
def test_without_noise_within_a_tenth_of_a_pixel(write_rig: Callable[..., Path], camera: str) -> None:
    rig = still_rig(write_rig, 0.0)
    for name, errors in errors_px(rig, camera, true_cameras(rig)[camera], 1).items():
        assert errors.max() < 0.1, name


@pytest.mark.parametrize("camera", CAMERAS)
def test_with_sensor_noise_within_a_fifth_of_a_pixel(write_rig: Callable[..., Path], camera: str) -> None:
    rig = still_rig(write_rig, 3.0)
    for name, errors in errors_px(rig, camera, true_cameras(rig)[camera], 60).items():
        assert np.percentile(errors, 95) < 0.2, name


@pytest.mark.parametrize("camera", CAMERAS)
def test_the_flat_patch_is_found_where_its_own_centre_projects(write_rig: Callable[..., Path], camera: str) -> None:
    """A patch hides nothing of itself: here the centre of the visible paint is the projected centre of the marker."""
    rig = still_rig(write_rig, 0.0)
    model = true_cameras(rig)[camera]
    world = World.from_rig(rig)
    (u, v) = model.project(world.sample(np.zeros(1)).markers["base"])[0]
    seen = MarkerCoverage(model, world, scale=8, vertices=64).at(0.0)["base"]
    assert np.hypot(seen.u - u, seen.v - v) < 0.1
