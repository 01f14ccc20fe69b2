"""Colours of two hands that share paints: all twelve markers picked, seven colours learnt."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from rhot.rig.config import SimConfig
from rhot_bench.speed.scaling import bare_rig
from rhot_calibration.colors.learning import learn_colors
from rhot_sim.rendering.renderer import Renderer
from rhot_sim.rig.calibration import true_cameras
from rhot_sim.world.motion import StillMotion
from rhot_sim.world.world import World


def test_picks_of_both_hands_become_one_colour_a_paint(tmp_path: Path) -> None:
    rig = bare_rig(tmp_path / "rig", 2, 2)
    world = World.from_rig(rig)
    world.motion = StillMotion(("right", "left"), ())
    camera = true_cameras(rig)["left"]
    picture = Renderer(camera, world, SimConfig(), rig.config.cameras["left"]).render(0.0)
    true = world.sample(np.zeros(1)).markers
    picks = {name: (float(u), float(v)) for name, (u, v) in ((n, camera.project(p)[0]) for n, p in true.items())}
    learnt = learn_colors([picture], [picks], rig.config.markers)
    assert set(learnt.calibration.colors.markers) == {
        *("thumb", "index", "middle", "ring", "little"),
        "base",
        "left_base",
    }
    found = learnt.detections[0]
    assert set(found) == set(picks)
    assert all(np.hypot(found[n].u - u, found[n].v - v) < 6.0 for n, (u, v) in picks.items())
