"""The cap model against the outlines of simulated hands, and against what is known without quadrature."""

from __future__ import annotations

import numpy as np
import pytest

from rhot.anatomy.hand import HandModel
from rhot.anatomy.skeleton import FINGERS
from rhot.geometry.camera import CameraModel
from rhot.rig import HandFile, MarkerConfig
from rhot_fusion.filter.cap_model import COSINES, CapModel, cap_table
from rhot_sim.rendering.coverage import MarkerCoverage
from rhot_sim.world.world import World

MARKERS = {finger: MarkerConfig(joint=f"{finger}_tip") for finger in FINGERS}
CENTRE_ON = COSINES // 2


def hand() -> HandModel:
    return HandModel.from_file(HandFile(date="2026-01-01", quality={}), "right")


def camera(x: float) -> CameraModel:
    T = np.eye(4)
    T[0, 3] = x
    K = np.array([[530.0, 0.0, 319.5], [0.0, 530.0, 239.5], [0.0, 0.0, 1.0]])
    return CameraModel.from_arrays(640, 480, K, np.zeros(0), T)


def test_a_cap_from_the_side_is_its_silhouette() -> None:
    """A cylinder with a half disc before it: 2 r l + π r² / 2."""
    r, length = 0.008, 0.007
    table = cap_table(r, r, 0.0)
    assert table.area_m2[CENTRE_ON] == pytest.approx(2.0 * r * length + 0.5 * np.pi * r**2, rel=2e-3)
    middle = (2.0 * r * length * (-0.5 * length) + 0.5 * np.pi * r**2 * 4.0 * r / (3.0 * np.pi)) / table.area_m2[
        CENTRE_ON
    ]
    assert table.shift_m[CENTRE_ON] == pytest.approx(middle, abs=2e-5)


def test_a_cap_from_the_front_is_a_disc_and_from_behind_nothing() -> None:
    table = cap_table(0.008, 0.008, 0.0)
    assert table.area_m2[-1] == pytest.approx(np.pi * 0.008**2, rel=2e-3)
    assert table.area_m2[0] < 1e-9
    assert (np.diff(table.area_m2[: CENTRE_ON + 1]) > 0.0).all()


@pytest.mark.parametrize("x", [0.0, 0.075])
def test_visible_middles_of_moving_hands(x: float) -> None:
    model = hand()
    world = World(3, {"right": model}, MARKERS)
    eye, caps = camera(x), CapModel(MARKERS, {"right": model})
    coverage = MarkerCoverage(eye, world, scale=6, vertices=48)
    plain, modelled = [], []
    for t_s in np.arange(0.3, 12.0, 0.4):
        sample, seen = world.sample(np.array([t_s])), coverage.at(t_s)
        for place, name in enumerate(MARKERS):
            middle = sample.markers[name][0]
            direction = -sample.joints["right"].rotation(f"{name}_tip")[0][:, 2]
            ray = eye.center - middle
            cosine = float(direction @ ray / np.linalg.norm(ray))
            shift, area = caps.look_up(place, cosine)
            whole_px = area * (530.0 / middle[2]) ** 2
            if seen[name].area_px < 0.97 * whole_px:
                continue
            found = np.array([seen[name].u, seen[name].v])
            plain.append(np.linalg.norm(found - eye.project(middle[None])[0]))
            modelled.append(np.linalg.norm(found - eye.project((middle + shift * direction)[None])[0]))
    assert len(modelled) > 80
    assert np.median(plain) > 1.0
    assert np.percentile(modelled, 95) < 0.1
