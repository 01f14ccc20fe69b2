from __future__ import annotations

import numpy as np
from marker_scenes import (
    DICTIONARY,
    SIZE_M,
    background,
    ball_depths,
    depth_camera,
    depth_image,
    draw_marker,
    plane_depths,
    tilted,
    with_noise,
)

from rhot.aruco_dictionary import marker_dictionary
from rhot_bench.thesis.feet import ThesisFeet

CAMERA = depth_camera()


def thesis() -> ThesisFeet:
    return ThesisFeet(marker_dictionary(DICTIONARY), {"left": 0, "right": 1}, SIZE_M)


def test_a_marker_is_where_its_centre_and_the_depth_are() -> None:
    R, t = tilted(20.0, 0.0), np.array([0.1, 0.05, 1.0])
    color = background(CAMERA)
    draw_marker(color, CAMERA, 0, R, t)
    depth = depth_image(plane_depths(CAMERA, R[:, 2], t), noise=0.0)
    feet = thesis().detect(with_noise(color), depth, CAMERA)
    assert set(feet) == {"left"}
    assert feet["left"].stage == "marker"
    assert 1e3 * float(np.linalg.norm(feet["left"].position - t)) < 6.0
    assert feet["left"].R_camera_marker is not None


def test_a_hidden_marker_gives_the_blob_near_the_last_place() -> None:
    wall = plane_depths(CAMERA, np.array([0.0, 0.0, 1.0]), np.array([0.0, 0.0, 2.0]))
    near = ball_depths(CAMERA, np.array([0.1, 0.05, 1.05]), 0.06)
    other = ball_depths(CAMERA, np.array([-0.3, 0.05, 1.05]), 0.06)
    depth = depth_image(np.minimum(np.minimum(wall, near), other), noise=0.0)
    follow = thesis()
    follow.start("left", tuple(CAMERA.project(np.array([[0.12, 0.06, 1.0]]))[0]), 1000.0)
    foot = follow.detect(background(CAMERA), depth, CAMERA)["left"]
    assert foot.stage == "depth"
    assert 1e3 * float(np.linalg.norm(foot.position - (0.1, 0.05, 0.99))) < 15.0
    nothing = np.zeros_like(depth)
    assert follow.detect(background(CAMERA), nothing, CAMERA) == {}
