"""Where the page looks from: upright, with everything in view."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest

from rhot.arrays import FloatArray
from rhot.rig import Rig
from rhot.rig.feet_config import FeetConfig, FootConfig
from rhot_viewer.grasp.hello import hello_text
from rhot_viewer.scene.viewpoint import (
    PicturePlane,
    Viewpoint,
    close_up,
    desk_middle,
    first_view,
    overview,
    through,
    up_direction,
    volume_lines,
)


def on_screen(view: Viewpoint, points: FloatArray, aspect: float = 1.0) -> FloatArray:
    """Return points (N, 3) in half heights of the window, x to the right and y up; NaN behind it."""
    forward = (view.look_at - view.position) / np.linalg.norm(view.look_at - view.position)
    right = np.cross(forward, view.up)
    right /= np.linalg.norm(right)
    x, y, z = ((points - view.position) @ np.stack([right, np.cross(right, forward), forward], axis=1)).T
    seen: FloatArray = np.stack([x / z / aspect, y / z], axis=1) / np.tan(0.5 * view.fov_rad)
    seen[z <= 0.0] = np.nan
    return seen


def test_the_overview_is_upright_and_shows_desk_and_cameras(rig: Rig) -> None:
    view = overview(rig)
    assert view.up.tolist() == [0.0, 0.0, -1.0], "against the view of a camera that looks down"
    cameras = np.array([np.array(camera.T_rig_camera)[:3, 3] for camera in rig.cameras.values()])
    desk = desk_middle(rig)
    assert desk == pytest.approx((0.0375, 0.0, rig.config.sim.desk_z_m))
    seen = on_screen(view, np.vstack([cameras, desk]))
    assert np.abs(seen).max() < 1.0, "all of it in a square window"
    assert (seen[:-1, 1] > seen[-1, 1] + 0.8).all(), "the cameras above the desk"


def test_a_rig_may_have_no_camera_but_the_one_on_the_head(rig: Rig) -> None:
    feet = FeetConfig(left=FootConfig(marker_id=1), up=(0.0, 1.0, 0.0))
    config = rig.config.model_copy(update={"feet": feet, "cameras": {}})
    walking = replace(rig, config=config, cameras={})
    assert desk_middle(walking).tolist() == [0.0, 0.0, 0.0]
    assert np.isfinite(first_view(walking).position).all()
    assert json.loads(hello_text(walking, {}, "", False, []))["desk"]["shown"] is False


def test_a_rig_with_feet_says_what_is_up(rig: Rig) -> None:
    feet = FeetConfig(left=FootConfig(marker_id=1), up=(0.0, 2.0, 0.0))
    standing = Rig(
        rig.path, rig.config.model_copy(update={"feet": feet}), rig.cameras, False, rig.hand, rig.registration
    )
    assert up_direction(standing).tolist() == [0.0, 1.0, 0.0]
    view = overview(standing)
    seen = on_screen(view, np.array([[0.0, 0.0, 0.0], [0.0, 1.8, 0.0]]))
    assert np.abs(seen).max() < 1.0, "a person from sole to crown"
    assert seen[1, 1] > seen[0, 1]


def test_a_page_opens_where_hands_will_be(rig: Rig) -> None:
    marker = next(iter(rig.config.markers.values()))
    for markers, palms in (
        (rig.config.markers, [[0.0, 0.0, -0.1]]),
        (
            {**rig.config.markers, "other": marker.model_copy(update={"hand": "left"})},
            [[-0.15, 0, -0.1], [0.15, 0, -0.1]],
        ),
    ):
        watched = replace(rig, config=rig.config.model_copy(update={"markers": markers}))
        seen = on_screen(first_view(watched), desk_middle(rig) + np.array(palms))
        assert np.abs(seen).max() < 0.6, "with room for the fingers"


def test_hands_are_seen_from_near_by_however_far_apart(rig: Rig) -> None:
    one = close_up(rig, np.array([[0.0, 0.0, 0.7]]))
    assert 0.3 < np.linalg.norm(one.position - one.look_at) < 0.6
    palms = np.array([[-0.3, 0.0, 0.7], [0.3, 0.0, 0.7]])
    assert np.abs(on_screen(close_up(rig, palms), palms)).max() < 0.9
    assert np.isfinite(close_up(rig, np.empty((0, 3))).position).all()


@pytest.mark.parametrize("aspect", [0.6, 4.0 / 3.0, 2.5])
def test_through_a_camera_its_picture_fills_the_window(rig: Rig, aspect: float) -> None:
    plane = PicturePlane.of(rig.cameras["right"])
    seen = on_screen(through(plane, aspect), plane.corners, aspect)
    assert np.abs(seen).max() == pytest.approx(1.0, abs=1e-6)
    upper_left = seen[0]
    assert upper_left[0] < 0.0 < upper_left[1], "neither mirrored nor upside down"


def test_the_volume_has_twelve_edges() -> None:
    lines = volume_lines((0.0, 0.0, 0.0), (1.0, 2.0, 3.0))
    lengths = np.sort(np.linalg.norm(lines[:, 1] - lines[:, 0], axis=1))
    assert lengths.tolist() == [1.0] * 4 + [2.0] * 4 + [3.0] * 4
