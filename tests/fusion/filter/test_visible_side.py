from __future__ import annotations

import numpy as np
import pytest

from rhot.geometry.camera import CameraModel
from rhot.geometry.rotations import rigid, rotation_z
from rhot_fusion.filter.visible_side import SkinSides, VisibleArea, visible_side

K = np.array([[500.0, 0.0, 320.0], [0.0, 500.0, 240.0], [0.0, 0.0, 1.0]])
PLACES = (np.eye(4), rigid(rotation_z(0.5), np.array([0.09, 0.0, 0.0])))
CAMERAS = [CameraModel.from_arrays(640, 480, K, np.zeros(5), T) for T in PLACES]
AREA = VisibleArea()
TIP, MIDDLE = (0.0, 0.0, 0.8), (0.0, 0.0, 0.0)


def sides() -> SkinSides:
    return SkinSides(CAMERAS, 2)


@pytest.mark.parametrize("c", [-0.9, -0.5, -0.1])
def test_the_bend_follows_from_the_area(c: float) -> None:
    assert AREA.bend(AREA.seen(c)) == pytest.approx(c, abs=0.01)


def test_the_finger_points_away_from_its_skin_in_every_camera() -> None:
    seen = sides()
    seen.observe(0, 1.0, [1], np.array([[0.0, 0.2]]))
    for k, camera in enumerate(CAMERAS):
        expected = camera.R_camera_rig @ (0.0, -1.0, 0.0)
        found = seen.direction(k, 1, 1.0)
        assert found is not None
        assert np.allclose(found, expected, atol=1e-9)
    assert seen.direction(0, 0, 1.0) is None


def test_views_of_turned_cameras_agree_and_their_noise_is_averaged() -> None:
    rng, seen = np.random.default_rng(1), sides()
    errors = []
    for number in range(200):
        for k, camera in enumerate(CAMERAS):
            true = (camera.R_camera_rig @ (0.14, 0.14, 0.0))[:2]
            seen.observe(k, number / 60.0, [0], true[None] + rng.normal(0.0, 0.06, (1, 2)))
        found = seen.direction(0, 0, number / 60.0)
        assert found is not None
        errors.append(np.arccos(np.clip(-np.array(found) @ (0.5**0.5, 0.5**0.5, 0.0), -1.0, 1.0)))
    one_view = 0.06 / 0.2
    assert np.sqrt(np.mean(np.square(errors[5:]))) < 0.5 * one_view


def test_skin_on_all_sides_and_old_views_say_nothing() -> None:
    seen = sides()
    seen.observe(0, 1.0, [0, 1], np.array([[0.0, 0.05], [0.0, 0.2]]))
    assert seen.direction(0, 0, 1.0) is None
    assert seen.direction(0, 1, 1.05) is not None
    assert seen.direction(0, 1, 1.2) is None
    seen.clear()
    assert seen.direction(0, 1, 1.0) is None


def test_directions_that_disagree_displace_less() -> None:
    up, right = (0.0, -1.0, 0.0), (1.0, 0.0, 0.0)
    alone, along, _ = visible_side([(1.0, up)], TIP, MIDDLE, -0.5, AREA)
    assert alone == pytest.approx(-0.5)
    assert np.allclose(along, up)
    both, _, _ = visible_side([(1.0, up), (1.0, up)], TIP, MIDDLE, -0.5, AREA)
    assert both == pytest.approx(alone)
    apart, between, _ = visible_side([(1.0, up), (1.0, right)], TIP, MIDDLE, -0.5, AREA)
    assert apart == pytest.approx(alone * 0.5**0.5)
    assert np.allclose(between, (0.5**0.5, -(0.5**0.5), 0.0))
    weak, _, _ = visible_side([(0.3, up)], TIP, MIDDLE, -0.5, AREA)
    assert weak == pytest.approx(0.3 * alone)
