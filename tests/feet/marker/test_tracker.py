from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from marker_scenes import (
    DICTIONARY,
    SIZE_M,
    background,
    depth_camera,
    depth_image,
    draw_marker,
    plane_depths,
    tilted,
    with_noise,
)
from numpy.typing import NDArray

from rhot.aruco_dictionary import R_FOOT_MARKER, marker_dictionary
from rhot.messages import Side
from rhot_feet.depth.plane import FloorPlane
from rhot_feet.frames import DepthFrame
from rhot_feet.marker.tracker import MarkerTracker
from rhot_feet.prediction import FootPrediction

CAMERA = depth_camera()
LEFT, RIGHT = np.array([-0.12, 0.1, 1.1]), np.array([0.10, 0.08, 1.1])
R = tilted(30.0, 0.0)
UP = R[:, 2]
ASIDE, NEARBY = np.array([0.35, -0.1, 0.0]), np.array([0.10, -0.12, 0.0])
Float = NDArray[np.float64]


def tracker() -> MarkerTracker:
    return MarkerTracker(marker_dictionary(DICTIONARY), {"left": 0, "right": 1}, SIZE_M, (0.3, 4.0))


def frame(index: int, positions: dict[int, Float], size_m: float = SIZE_M) -> DepthFrame:
    """A picture with markers (number to position), all in one tilted plane with the floor's depth."""
    color = background(CAMERA, index)
    for marker_id, position in positions.items():
        draw_marker(color, CAMERA, marker_id, R, position, size_m)
    depths = plane_depths(CAMERA, UP, LEFT)
    for position in positions.values():
        u, v = CAMERA.project(position[None])[0].astype(int)
        part = np.s_[v - 30 : v + 30, u - 30 : u + 30]
        depths[part] = plane_depths(CAMERA, UP, position)[part]
    return DepthFrame(index * 16_666_667, with_noise(color, index), depth_image(depths, index), CAMERA, index)


def expected(position: Float, sigma_m: float = 0.02) -> FootPrediction:
    return FootPrediction(position, sigma_m**2 * np.eye(3), R @ R_FOOT_MARKER.T, 0.02 * np.eye(3))


BOTH: dict[Side, FootPrediction] = {"left": expected(LEFT), "right": expected(RIGHT)}


def test_both_feet_to_millimetres() -> None:
    errors = []
    follow = tracker()
    for index in range(6):
        found = follow.detect(frame(index, {0: LEFT, 1: RIGHT}), BOTH, UP).markers
        assert set(found) == {"left", "right"}
        for side, position in (("left", LEFT), ("right", RIGHT)):
            errors.append(found[side].position - position)  # type: ignore[index]
            assert found[side].orientation_known  # type: ignore[index]
            assert found[side].with_depth  # type: ignore[index]
            turned = found[side].R_camera_foot.T @ R @ R_FOOT_MARKER.T  # type: ignore[index]
            assert np.degrees(np.arccos((np.trace(turned) - 1.0) / 2.0)) < 4.0
    assert 1e3 * float(np.sqrt(np.mean(np.sum(np.square(errors), axis=1)))) < 5.0


def test_unexpected_feet_are_believed_at_the_third_sight() -> None:
    follow = tracker()
    seen = [set(follow.detect(frame(index, {0: LEFT}), {}).markers) for index in range(4)]
    assert seen == [set(), set(), {"left"}, {"left"}]


def test_a_marker_that_jumps_about_is_never_believed() -> None:
    follow, rng = tracker(), np.random.default_rng(0)
    for index in range(8):
        position = np.array([rng.uniform(-0.3, 0.3) + (0.4 if index % 2 else -0.4), 0.1, 1.1])
        assert not follow.detect(frame(index, {0: position}), {}).markers


def test_a_false_marker_away_from_the_foot_is_refused() -> None:
    follow = tracker()
    wide = {"left": expected(LEFT, 0.05), "right": expected(RIGHT)}
    found = follow.detect(frame(0, {0: LEFT + ASIDE, 1: RIGHT}), wide, UP)  # type: ignore[arg-type]
    assert set(found.markers) == {"right"}
    everywhere = {"left": expected(LEFT, 0.08), "right": expected(RIGHT, 0.4)}
    found = follow.detect(frame(1, {0: LEFT + ASIDE}), everywhere, UP)  # type: ignore[arg-type]
    assert not found.markers
    assert found.refused == {"left": "motion"}


def test_the_nearer_of_two_alike_is_the_foots() -> None:
    color = frame(0, {0: LEFT + NEARBY})
    true = frame(0, {0: LEFT, 1: RIGHT})
    both = true.color.copy()
    changed = np.abs(color.color.astype(int) - 120).max(axis=2) > 40
    both[changed] = color.color[changed]
    wide: dict[Side, FootPrediction] = {"left": expected(LEFT, 0.06), "right": expected(RIGHT)}
    found = tracker().detect(replace(true, color=both, depth_mm=None), wide, UP).markers
    assert 1e3 * float(np.linalg.norm(found["left"].position - LEFT)) < 15.0


@pytest.mark.parametrize("share", [0.5, 0.8, 1.25, 2.0])
def test_depth_that_contradicts_the_size_refuses(share: float) -> None:
    # A marker twice as large at the same position looks as if it were half as far away.
    found = tracker().detect(frame(0, {0: LEFT}, share * SIZE_M), {"left": expected(LEFT, 0.5)}, UP)
    assert not found.markers
    assert found.refused == {"left": "depth"}


def test_a_marker_that_looks_down_is_refused() -> None:
    found = tracker().detect(frame(0, {0: LEFT}), {"left": expected(LEFT)}, -UP)
    assert found.refused == {"left": "tilt"}


def test_a_marker_turned_away_from_its_foot_is_refused() -> None:
    across = tilted(30.0, 0.0, np.pi / 2.0) @ R_FOOT_MARKER.T
    turned = replace(expected(LEFT), R_camera_foot=across)
    assert tracker().detect(frame(0, {0: LEFT}), {"left": turned}, UP).refused == {"left": "turn"}


def test_paper_on_the_floor_and_a_marker_on_the_other_foot_are_refused() -> None:
    seen, wide = frame(0, {0: LEFT}), {"left": expected(LEFT, 0.2)}
    lying = FloorPlane(-UP / float(-UP @ (LEFT - 0.01 * UP)))
    assert tracker().detect(seen, wide, UP, lying).refused == {"left": "floor"}  # type: ignore[arg-type]
    under = FloorPlane(-UP / float(-UP @ (LEFT - 0.07 * UP)))
    assert set(tracker().detect(seen, wide, UP, under).markers) == {"left"}  # type: ignore[arg-type]
    stuck = frame(0, {0: RIGHT})
    both = {"left": expected(LEFT, 0.2), "right": expected(RIGHT)}
    assert tracker().detect(stuck, both, UP).refused == {"left": "other"}  # type: ignore[arg-type]


def test_at_the_pictures_edge_without_depth_and_out_of_sight() -> None:
    seen = frame(0, {0: LEFT})
    cut = DepthFrame(0, seen.color[:, 348:], None, CAMERA, 0)
    u, v = CAMERA.project(LEFT[None])[0] - (348.0, 0.0)
    assert u < 18.0
    at_edge = expected(np.array([*(CAMERA.undistort(np.array([[u, v]]))[0] * 1.1), 1.1]))
    assert not tracker().detect(cut, {"left": at_edge}, UP).markers
    marker = tracker().detect(replace(seen, depth_mm=None), {"left": expected(LEFT)}, UP).markers["left"]
    assert not marker.with_depth
    nothing = DepthFrame(0, background(CAMERA), np.zeros((480, 848), np.uint16), CAMERA, 0)
    assert not tracker().detect(nothing, BOTH, UP).markers
    behind = {"left": expected(np.array([0.0, 0.0, -1.0])), "right": expected(RIGHT)}
    assert not tracker().detect(seen, behind, UP).markers  # type: ignore[arg-type]
