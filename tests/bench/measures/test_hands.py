from __future__ import annotations

import numpy as np
import pytest

from rhot.anatomy.hand import HandModel
from rhot.anatomy.skeleton import FINGERS, JOINTS
from rhot.geometry.camera import CameraModel
from rhot.rig import CameraConfig, HandFile, MarkerConfig
from rhot.rig.cameras import camera_models
from rhot_bench.hands.accuracy import START_NS, HandRun, against_truth, excess_steps_m, hand_figures
from rhot_sim.rig.calibration import simulated_rig_calibration
from rhot_sim.world.world import World

SEED = 1


@pytest.fixture(scope="module")
def world() -> World:
    markers = {finger: MarkerConfig(joint=f"{finger}_tip") for finger in FINGERS}
    markers["base"] = MarkerConfig(joint="wrist", kind="patch", size_m=(0.04, 0.03))
    return World(SEED, {"right": HandModel.from_file(HandFile(), "right")}, markers, ("cube",))


@pytest.fixture(scope="module")
def cameras() -> dict[str, CameraModel]:
    configs = {"left": CameraConfig(), "right": CameraConfig(position_m=(0.075, 0.0, 0.0))}
    truth = simulated_rig_calibration(configs, SEED).truth.cameras
    return camera_models(truth)


def run_of(world: World, t_s: np.ndarray) -> HandRun:
    sample = world.sample(t_s)
    positions, angles = sample.joints["right"].positions, sample.angles["right"]
    return HandRun(t_s, positions.copy(), positions, angles.copy(), angles, np.ones((len(t_s), 5), dtype=bool))


def test_the_truth_has_no_error_and_known_errors_are_found(world: World) -> None:
    model, t_s = world.hands["right"], np.arange(0.0, 3.0, 1 / 60)
    run = run_of(world, t_s)
    figures = hand_figures(run, model)
    assert figures.joints_mm == pytest.approx(0.0)
    assert figures.step_off_mm == pytest.approx(0.0)
    assert figures.beyond_limits_deg == 0.0
    run.positions[:, :, 0] += 0.003
    run.angles[:, 1:, 2] += np.radians(5.0)
    run.measured[:90, 2] = False
    run.positions[:90] += np.array([0.0, 0.004, 0.0])
    figures = hand_figures(run, model)
    assert figures.joints_mm == pytest.approx(3.0)
    assert figures.joints_hidden_mm == pytest.approx(5.0)
    # Four of five fingers.
    assert figures.angles_deg["pip_flexion"] == pytest.approx(5.0 * 0.8**0.5)
    assert figures.angles_deg["mcp_flexion"] == pytest.approx(0.0)
    assert figures.step_off_mm == pytest.approx(4.0)


def test_an_angle_beyond_its_limit_shows(world: World) -> None:
    model = world.hands["right"]
    run = run_of(world, np.arange(0.0, 2.0, 1 / 60))
    run.angles[70, 2, 1] = model.angle_max[2, 1] + np.radians(2.0)
    assert hand_figures(run, model).beyond_limits_deg == pytest.approx(2.0)


def test_gaps_are_no_steps(world: World) -> None:
    run = run_of(world, np.array([0.0, 1 / 60, 1.0, 1.0 + 1 / 60]))
    run.positions[2:] += 0.05
    run.positions[3, JOINTS.index("wrist")] += np.array([0.006, 0.0, 0.0])
    longer, off = excess_steps_m(run)
    assert off[1].max() == 0.0
    assert off.max() == pytest.approx(0.006)
    assert longer.max() <= 0.006 + 1e-12


def test_a_stage_that_answers_nothing_gives_an_empty_run(world: World) -> None:
    run = against_truth([], world, "right", START_NS)
    assert run.positions.shape == (0, 26, 3)
    figures = hand_figures(run, world.hands["right"])
    assert figures.poses == 0
    assert np.isnan(figures.joints_mm)
