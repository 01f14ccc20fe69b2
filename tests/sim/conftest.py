"""Worlds, cameras and a way to measure what was drawn, for the tests of the simulation."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import cv2
import numpy as np
import pytest

from rhot.anatomy.hand import HandModel
from rhot.arrays import FloatArray
from rhot.geometry.camera import CameraModel
from rhot.messages import Side
from rhot.rig import CameraConfig, HandFile, MarkerConfig
from rhot.rig.cameras import camera_models
from rhot.rig.config import SimConfig
from rhot_sim.rendering.renderer import Renderer
from rhot_sim.rig.calibration import simulated_rig_calibration
from rhot_sim.world.motion import MotionSample, StillMotion
from rhot_sim.world.world import World

Measure = Callable[[World, CameraModel, str], Callable[[float, float, float], FloatArray]]


@pytest.fixture(autouse=True)
def _one_thread() -> None:
    cv2.setNumThreads(1)


@pytest.fixture(scope="session")
def markers() -> dict[str, MarkerConfig]:
    return {
        **{finger: MarkerConfig(joint=f"{finger}_tip") for finger in ("thumb", "index", "middle", "ring", "little")},
        "base": MarkerConfig(joint="wrist", kind="patch", size_m=(0.04, 0.025)),
    }


@pytest.fixture(scope="session")
def hands() -> dict[Side, HandModel]:
    return {"right": HandModel.from_file(HandFile(), "right")}


@pytest.fixture(scope="session")
def cameras() -> dict[str, CameraModel]:
    configs = {name: CameraConfig(source="simulated") for name in ("left", "right")}
    truth = simulated_rig_calibration(configs, seed=1).truth.cameras
    return camera_models(truth)


@pytest.fixture
def world(hands: dict[Side, HandModel], markers: dict[str, MarkerConfig]) -> World:
    return World(1, hands, markers, ["box"])


@dataclass(frozen=True)
class Sliding:
    """The still hand, moved at a constant velocity, metres per second."""

    velocity: tuple[float, float, float]

    def sample(self, t_s: FloatArray) -> MotionSample:
        still = StillMotion(("right",), ()).sample(t_s)
        wrists = still.wrists["right"].copy()
        wrists[:, :3, 3] += np.outer(t_s, self.velocity)
        return MotionSample({"right": wrists}, still.angles, {})


@pytest.fixture
def sliding(
    hands: dict[Side, HandModel], markers: dict[str, MarkerConfig]
) -> Callable[[tuple[float, float, float]], World]:
    return lambda velocity: World(1, hands, markers, (), motion=Sliding(velocity))


@pytest.fixture
def measure() -> Measure:
    """Give a function (t, exposure, readout) -> share of each pixel that shows a marker, (H, W)."""

    def of(world: World, camera: CameraModel, marker: str) -> Callable[[float, float, float], FloatArray]:
        config = SimConfig(noise_sigma=0.0, light_drift=0.0)
        black = dict.fromkeys(["skin", "object", *world.markers], (0.0, 0.0, 0.0))
        # So bright that every shade of the paint is white.
        white = {**black, marker: (1e3, 1e3, 1e3)}
        without, with_it = (
            Renderer(camera, world, config, CameraConfig(source="simulated"), paints=paints)
            for paints in (black, white)
        )

        def shares(t_s: float, exposure_s: float, readout_s: float) -> FloatArray:
            dark = without.render(t_s, exposure_s, readout_s)[..., 0].astype(np.float64)
            bright = with_it.render(t_s, exposure_s, readout_s)[..., 0].astype(np.float64)
            share: FloatArray = (bright - dark) / (255.0 - dark)
            return share

        return shares

    return of
