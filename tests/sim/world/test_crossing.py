"""Two hands that touch and cross: where they must meet, and how far apart they must stay."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest
from click.testing import CliRunner

from rhot.anatomy.hand import HandModel
from rhot.anatomy.markers import own_paints
from rhot.anatomy.skeleton import JOINTS
from rhot.errors import ConfigError
from rhot.messages import Side
from rhot.rig import HandFile
from rhot.rig.colors import nominal_colors
from rhot.rig.config import SimConfig
from rhot_bench.speed.scaling import bare_rig
from rhot_capture.detection.color_table import build_color_table
from rhot_capture.detection.detector import MarkerDetector
from rhot_sim.command import sim
from rhot_sim.rendering.renderer import Renderer
from rhot_sim.rig.calibration import true_cameras
from rhot_sim.world.paint import paints_of
from rhot_sim.world.world import CYCLE_S, CrossingMotion, World

HANDS: dict[Side, HandModel] = {
    "right": HandModel.from_file(HandFile(), "right"),
    "left": HandModel.from_file(HandFile(), "left"),
}


def world(seed: int) -> World:
    return World(seed, HANDS, {}, motion=CrossingMotion(seed, HANDS))


@pytest.mark.parametrize("seed", [1, 2, 3])
def test_fingertips_meet_and_hands_cross_one_above_the_other(seed: int) -> None:
    cycles = 4
    sample = world(seed).sample(np.arange(0.0, cycles * CYCLE_S, 0.05))
    right, left = (sample.joints[side].positions for side in ("right", "left"))
    tips = [JOINTS.index("index_tip"), JOINTS.index("middle_tip")]
    gap = np.linalg.norm(right[:, tips] - left[:, tips], axis=-1).min(axis=-1).reshape(cycles, -1)
    radius = HANDS["right"].radii[tips[0]]
    # In every cycle two tips come as near as skin allows, give or take a finger's sway.
    assert (gap.min(axis=1) < 2.0 * radius + 0.012).all()
    palm = JOINTS.index("palm")
    across = (right[:, palm, 0] - left[:, palm, 0]).reshape(cycles, -1)
    assert (across[:, 0] < -0.2).all()
    assert across.max() > 0.0, "some cycle brings the right hand to the left one's left"
    near = np.abs(across.ravel()) < 0.06
    assert near.any()
    assert np.abs(right[near, palm, 2] - left[near, palm, 2]).min() > 0.06


def test_motion_is_smooth_over_the_end_of_a_cycle_and_follows_from_the_time_alone() -> None:
    t_s = np.array([CYCLE_S - 1e-3, CYCLE_S, CYCLE_S + 1e-3])
    one, other = world(5).sample(t_s), world(5).sample(t_s[::-1])
    palms = one.joints["right"].position("palm")
    assert np.abs(np.diff(palms, axis=0)).max() < 1e-3
    np.testing.assert_array_equal(palms, other.joints["right"].position("palm")[::-1])


def test_one_hand_cannot_cross() -> None:
    with pytest.raises(ConfigError, match="both hands"):
        CrossingMotion(1, {"right": HANDS["right"]})


def test_command_refuses_to_let_one_hand_cross() -> None:
    done = CliRunner().invoke(sim, ["--motion", "crossing"])
    assert isinstance(done.exception, ConfigError)
    assert "--hands both" in str(done.exception)


def test_detector_finds_twelve_markers_of_seven_paints(tmp_path: Path) -> None:
    rig = bare_rig(tmp_path / "rig", 2, 2)
    markers = rig.config.markers
    own = own_paints(markers)
    assert (len(markers), len(own)) == (12, 7)
    scene = World(1, HANDS, markers, motion=CrossingMotion(1, HANDS))
    camera = true_cameras(rig)["left"]
    renderer = Renderer(camera, scene, SimConfig(), rig.config.cameras["left"])
    colors = nominal_colors({name: (red, green, blue) for name, (blue, green, red) in paints_of(own).items()})
    detector = MarkerDetector(markers, build_color_table(colors, list(own)), camera.width, camera.height)
    cv2.setNumThreads(1)
    for t_s in (0.2, 0.21, 0.22):
        found = detector.detect(renderer.render(t_s))
    true = scene.sample(np.array([0.225])).markers
    off = {name: np.hypot(*(camera.project(true[name])[0] - (each.u, each.v))) for name, each in found.items()}
    assert set(found) >= set(markers) - {"thumb", "left_thumb"}, "thumbs may be half hidden"
    assert max(off.values()) < 8.0, off
