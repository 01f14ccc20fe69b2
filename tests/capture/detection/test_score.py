from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from rhot.rig import load_rig
from rhot.rig.colors import nominal_colors
from rhot_capture.detection.color_table import build_color_table
from rhot_capture.detection.detector import MarkerDetector
from rhot_capture.detection.score import RIGHT_PX, Evidence, probability
from rhot_sim.rendering.coverage import MarkerCoverage
from rhot_sim.rendering.renderer import Renderer
from rhot_sim.rig.calibration import true_cameras
from rhot_sim.world.paint import paints_of
from rhot_sim.world.world import World

Evidences = st.builds(Evidence, *[st.floats(-5.0, 0.0)] * 3)


@given(Evidences, Evidences)
def test_more_evidence_never_makes_a_detection_less_sure(first: Evidence, second: Evidence) -> None:
    less = Evidence(*(min(one, other) for one, other in zip(first, second, strict=True)))
    assert 0.0 <= probability(less) <= min(probability(first), probability(second)) <= 1.0


def test_a_flawless_marker_is_as_good_as_sure_and_a_cut_one_is_not() -> None:
    whole = Evidence(0.0, 0.0, 0.0)
    assert probability(whole) > 0.9
    assert probability(whole._replace(inside=-0.3)) < 0.5
    assert probability(whole._replace(alone=np.log(0.5))) < 0.5


@pytest.mark.parametrize("camera", ["left", "right"])
def test_scores_mean_what_they_say(write_rig: Callable[..., Path], camera: str) -> None:
    """On motion, noise and cameras that the constants were not fitted to."""
    rig = load_rig(write_rig(dict.fromkeys(("left", "right"), 'source = "simulated"\n'), "[sim]\nseed = 77\n"))
    model, world = true_cameras(rig)[camera], World.from_rig(rig)
    place = list(rig.config.cameras).index(camera)
    renderer = Renderer(model, world, rig.config.sim, rig.config.cameras[camera], place)
    names = list(rig.config.markers)
    colors = nominal_colors({name: (red, green, blue) for name, (blue, green, red) in paints_of(names).items()})
    detector = MarkerDetector(rig.config.markers, build_color_table(colors, names), model.width, model.height)
    coverage = MarkerCoverage(model, world, scale=6, vertices=48)
    scores, right = [], []
    for t_s in np.linspace(3.0, 90.0, 40):
        detector.reset()
        views = coverage.at(t_s + 0.003)
        for name, found in detector.detect(renderer.render(t_s, exposure_s=0.006, readout_s=0.0)).items():
            scores.append(found.score)
            near = np.hypot(found.u - views[name].u, found.v - views[name].v) <= RIGHT_PX
            right.append(near and views[name].area_px > 0.0)
    sure = np.array(scores) > 0.85
    assert sure.sum() > 100
    assert np.mean(np.array(right)[sure]) == pytest.approx(np.mean(np.array(scores)[sure]), abs=0.05)
