from __future__ import annotations

import csv
from pathlib import Path

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
from rhot_bench.thesis_feet import ThesisFeet
from rhot_feet.frames import pinhole
from rhot_feet.sources.recorded_frames import load_depth_recording

CAMERA = depth_camera()


def thesis() -> ThesisFeet:
    return ThesisFeet(marker_dictionary(DICTIONARY), {"left": 0, "right": 1}, SIZE_M)


def test_a_marker_is_where_its_centre_and_the_depth_are() -> None:
    R, t = tilted(20.0, 0.0), np.array([0.1, 0.05, 1.0])
    color = background(CAMERA)
    draw_marker(color, CAMERA, 0, R, t)
    depth = depth_image(plane_depths(CAMERA, R[:, 2], t), noise=0.0)
    feet = thesis().feed(with_noise(color), depth, CAMERA)
    assert set(feet) == {"left"}
    assert feet["left"].stage == "marker"
    assert 1e3 * float(np.linalg.norm(feet["left"].place - t)) < 6.0
    assert feet["left"].R_camera_marker is not None


def test_a_hidden_marker_gives_the_blob_near_the_last_place() -> None:
    wall = plane_depths(CAMERA, np.array([0.0, 0.0, 1.0]), np.array([0.0, 0.0, 2.0]))
    near = ball_depths(CAMERA, np.array([0.1, 0.05, 1.05]), 0.06)
    other = ball_depths(CAMERA, np.array([-0.3, 0.05, 1.05]), 0.06)
    depth = depth_image(np.minimum(np.minimum(wall, near), other), noise=0.0)
    follow = thesis()
    follow.start("left", tuple(CAMERA.project(np.array([[0.12, 0.06, 1.0]]))[0]), 1000.0)
    foot = follow.feed(background(CAMERA), depth, CAMERA)["left"]
    assert foot.stage == "depth"
    assert 1e3 * float(np.linalg.norm(foot.place - (0.1, 0.05, 0.99))) < 15.0
    nothing = np.zeros_like(depth)
    assert follow.feed(background(CAMERA), nothing, CAMERA) == {}


def test_recorded_walk_on_which_the_thesiss_blob_loses_the_toes(shared_data: Path) -> None:
    folder = shared_data / "realsense" / "feet_rgbd"
    camera = pinhole(640, 480, np.array([[610.0, 0.0, 320.0], [0.0, 610.0, 240.0], [0.0, 0.0, 1.0]]), np.empty(0))
    with (folder / "manual_toe_tips.csv").open() as stream:
        marks = {int(row["frame"]): row for row in csv.DictReader(stream)}
    follow, distances = thesis(), []
    for side in ("left", "right"):
        u, v, z = (float(marks[0][f"{side}_toe_{name}"]) for name in ("u", "v", "depth_mm"))
        follow.start(side, (u, v), z)
    for frame in load_depth_recording(folder, camera=camera, rate_hz=30.0).frames():
        assert frame.depth_mm is not None
        feet = follow.feed(frame.color, frame.depth_mm, camera)
        if frame.index == 0 or frame.index not in marks:
            continue
        for side, foot in feet.items():
            u, v = camera.project(foot.place[None])[0]
            mark = marks[frame.index]
            distances.append(np.hypot(u - float(mark[f"{side}_toe_u"]), v - float(mark[f"{side}_toe_v"])))
    assert np.mean(np.array(distances) < 15.0) < 0.5
