from __future__ import annotations

import numpy as np
import pytest
from marker_scenes import background, ball_depths, depth_camera, depth_image, plane_depths
from numpy.typing import NDArray

from rhot.geometry.hull import Region
from rhot.geometry.rotations import rotation_x
from rhot.messages import Side
from rhot_feet.depth.plane import COARSE_PX, FloorPlane, PixelRays, find_floor
from rhot_feet.depth.tracker import DepthTracker
from rhot_feet.frames import DepthFrame
from rhot_feet.prediction import FootPrediction

CAMERA = depth_camera()
WHOLE = Region(0, 0, CAMERA.width, CAMERA.height)
RANGE = (0.3, 4.0)
Float = NDArray[np.float64]
# A camera 1.3 m over the floor, looking 60 degrees down: y of the camera frame is up there.
R_CAMERA_WORLD = rotation_x(np.radians(60.0)) @ np.diag([1.0, -1.0, -1.0])
UP = R_CAMERA_WORLD[:, 1]
FLOOR = -1.3 * UP
STEP = np.array([0.06, 0.03, 0.0])


def position(x: float, height: float, ahead: float) -> Float:
    """A point over the floor, camera frame: to the right, up and ahead of the camera, metres."""
    point: Float = FLOOR + R_CAMERA_WORLD @ np.array([x, height, -ahead])
    return point


def foot_depths(marker: Float) -> Float:
    """A shoe as three balls in a row, an ankle over its heel; the marker is on top of the middle."""
    along, up = R_CAMERA_WORLD[:, 2], UP
    balls = [marker - 0.04 * up + step * along for step in (-0.09, -0.03, 0.03)]
    shank = [marker + 0.05 * step * up + 0.10 * along for step in range(2)]
    depths = [ball_depths(CAMERA, ball, 0.045) for ball in balls] + [ball_depths(CAMERA, ball, 0.05) for ball in shank]
    nearest: Float = np.min(depths, axis=0)
    return nearest


def picture(feet: dict[Side, Float], seed: int = 0, noise: float = 0.004) -> DepthFrame:
    depths = plane_depths(CAMERA, UP, FLOOR)
    for marker in feet.values():
        foot = foot_depths(marker)
        depths = np.where(foot < np.where(depths > 0.0, depths, np.inf), foot, depths)
    color = background(CAMERA)
    return DepthFrame(seed, color, depth_image(depths, seed, noise), CAMERA, seed)


def expected(marker: Float, sigma_m: float = 0.03) -> FootPrediction:
    return FootPrediction(marker, sigma_m**2 * np.eye(3), R_CAMERA_WORLD, 0.01 * np.eye(3))


def test_the_floor_is_found_beside_a_table_and_with_noise() -> None:
    rays = PixelRays(CAMERA, COARSE_PX)
    depths = plane_depths(CAMERA, UP, FLOOR)
    table = plane_depths(CAMERA, UP, FLOOR + 0.7 * UP)
    depths[:, :300] = table[:, :300]
    floor = find_floor(rays.points(depth_image(depths), WHOLE, RANGE), UP)
    assert floor is not None
    assert np.degrees(np.arccos(float(floor.up @ UP))) < 1.0
    assert abs(1e3 * float(floor.heights_m(FLOOR[None])[0])) < 10.0
    assert abs(1e3 * float(floor.heights_m((FLOOR + 0.2 * UP)[None])[0]) - 200.0) < 10.0


def test_a_wall_is_no_floor_and_nothing_is_none() -> None:
    rays = PixelRays(CAMERA, COARSE_PX)
    wall = plane_depths(CAMERA, np.array([0.0, 0.0, 1.0]), np.array([0.0, 0.0, 2.0]))
    assert find_floor(rays.points(depth_image(wall), WHOLE, RANGE), np.array([0.0, -1.0, 0.0])) is None
    assert find_floor(rays.points(np.zeros((480, 848), np.uint16), WHOLE, RANGE)) is None


def test_hidden_feet_are_found_where_they_went() -> None:
    tracker, rng = DepthTracker(RANGE), np.random.default_rng(0)
    at: dict[Side, Float] = {"left": position(-0.12, 0.085, 0.7), "right": position(0.12, 0.085, 0.75)}
    for seed in range(4):
        tracker.detect(picture(at, seed), {}, {side: expected(marker) for side, marker in at.items()}, UP)
    errors, normalised = [], []
    for seed in range(8):
        moved = {side: position(*(rng.uniform(-0.05, 0.05, 3) + STEP)) - position(0, 0, 0) for side in at}
        now: dict[Side, Float] = {side: marker + moved[side] for side, marker in at.items()}
        guess: dict[Side, FootPrediction] = {
            side: expected(marker + rng.normal(0.0, 0.02, 3)) for side, marker in now.items()
        }
        found = tracker.detect(picture(now, 10 + seed), guess, {}, UP)
        assert set(found.feet) == {"left", "right"}, found.refused
        for side, foot in found.feet.items():
            errors.append(foot.position - now[side])
            normalised.append(errors[-1] @ np.linalg.solve(foot.covariance, errors[-1]) / 3.0)
    assert 1e3 * float(np.mean(np.linalg.norm(errors, axis=1))) < 12.0
    assert float(np.mean(normalised)) < 2.0


def half_hidden(marker: Float, seed: int) -> DepthFrame:
    """A foot before whose toes a knee near the camera stands."""
    depths = np.minimum(plane_depths(CAMERA, UP, FLOOR), np.where((it := foot_depths(marker)) > 0.0, it, np.inf))
    row = round(float(CAMERA.project(marker[None])[0, 1])) - 10
    depths[:row] = 0.6
    return DepthFrame(seed, background(CAMERA), depth_image(depths, seed), CAMERA, seed)


def test_a_foot_half_hidden_by_a_knee_stays_where_it_is() -> None:
    tracker, marker = DepthTracker(RANGE), position(0.0, 0.085, 0.7)
    for seed in range(4):
        tracker.detect(picture({"left": marker}, seed), {}, {"left": expected(marker)}, UP)
    half = half_hidden(marker, 9)
    found = tracker.detect(half, {"left": expected(marker + np.array([0.01, 0.0, 0.01]))}, {}, UP)
    assert set(found.feet) == {"left"}, found.refused
    assert 1e3 * float(np.linalg.norm(found.feet["left"].position - marker)) < 12.0


def test_a_side_that_was_hidden_when_the_foot_was_learnt_does_not_pull_it() -> None:
    """The knee stood before the toes all the time; now that they are seen, they are no part of what is compared."""
    tracker, marker = DepthTracker(RANGE), position(0.0, 0.085, 0.7)
    for seed in range(4):
        tracker.detect(half_hidden(marker, seed), {}, {"left": expected(marker)}, UP)
    whole = picture({"left": marker}, 9)
    found = tracker.detect(whole, {"left": expected(marker + np.array([0.01, 0.0, 0.01]))}, {}, UP)
    assert set(found.feet) == {"left"}, found.refused
    assert 1e3 * float(np.linalg.norm(found.feet["left"].position - marker)) < 12.0


def test_what_was_learnt_in_the_axes_of_the_foot_is_not_used_in_those_of_the_camera() -> None:
    tracker, marker = DepthTracker(RANGE), position(0.0, 0.085, 0.7)
    for seed in range(4):
        tracker.detect(picture({"left": marker}, seed), {}, {"left": expected(marker)}, UP)
    turned = FootPrediction(marker, 0.03**2 * np.eye(3))
    assert tracker.detect(picture({"left": marker}, 9), {"left": turned}, {}, UP).refused == {"left": "unknown"}


def test_a_foot_that_may_be_turned_is_less_surely_where_it_is_found() -> None:
    tracker, marker = DepthTracker(RANGE), position(0.0, 0.085, 0.7)
    for seed in range(4):
        tracker.detect(picture({"left": marker}, seed), {}, {"left": expected(marker)}, UP)
    sigmas = []
    for rotation_rad in (0.1, 1.0):
        foot = FootPrediction(marker, 0.03**2 * np.eye(3), R_CAMERA_WORLD, rotation_rad**2 * np.eye(3))
        found = tracker.detect(half_hidden(marker, 9), {"left": foot}, {}, UP).feet["left"]
        sigmas.append(float(np.sqrt(np.trace(found.covariance))))
    assert sigmas[1] > 1.3 * sigmas[0]


def test_a_floor_once_measured_is_where_the_moved_camera_sees_it() -> None:
    floor = FloorPlane(-UP / float(-UP @ FLOOR))
    turn, step = rotation_x(0.2), np.array([0.1, -0.2, 0.05])
    T_old_new = np.eye(4)
    T_old_new[:3, :3], T_old_new[:3, 3] = turn, step
    point = turn.T @ (FLOOR + 0.3 * UP - step)
    assert float(floor.seen_from(T_old_new).heights_m(point)) == pytest.approx(0.3, abs=1e-9)


def test_feet_side_by_side_stay_two() -> None:
    tracker = DepthTracker(RANGE)
    apart: dict[Side, Float] = {"left": position(-0.12, 0.085, 0.7), "right": position(0.12, 0.085, 0.7)}
    for seed in range(3):
        tracker.detect(picture(apart, seed), {}, {side: expected(marker) for side, marker in apart.items()}, UP)
    for gap in (0.20, 0.15, 0.11, 0.095):
        close: dict[Side, Float] = {
            "left": position(-0.5 * gap, 0.085, 0.7),
            "right": position(0.5 * gap, 0.085, 0.7),
        }
        found = tracker.detect(picture(close, 9), {side: expected(marker) for side, marker in close.items()}, {}, UP)
        distance = np.linalg.norm(found.feet["left"].position - found.feet["right"].position)
        assert abs(1e3 * float(distance) - 1e3 * gap) < 20.0


def test_a_foot_that_may_be_anywhere_is_not_taken_for_the_other_one() -> None:
    """The left foot is out of sight, with the right one standing about where it is expected."""
    tracker, left, right = DepthTracker(RANGE), position(-0.12, 0.085, 0.7), position(0.12, 0.085, 0.75)
    both: dict[Side, FootPrediction] = {"left": expected(left), "right": expected(right)}
    for seed in range(4):
        tracker.detect(picture({"left": left, "right": right}, seed), {}, both, UP)
    alone = picture({"right": right}, 9)
    lost = expected(0.4 * left + 0.6 * right, sigma_m=0.1)
    # Nobody knows that it is the right one.
    assert tracker.detect(alone, {"left": lost}, {}, UP).refused == {"left": "vague"}
    # Its marker is seen, but there is half of it left when the other half is taken for the left one.
    assert tracker.detect(alone, {"left": lost}, {"right": expected(right)}, UP).refused == {"left": "other"}


def test_what_is_not_a_foot_is_refused() -> None:
    tracker = DepthTracker(RANGE)
    at: dict[Side, Float] = {"left": position(-0.12, 0.085, 0.7)}
    here = {side: expected(marker) for side, marker in at.items()}
    assert tracker.detect(picture(at), here, {}, UP).refused == {"left": "unknown"}
    tracker.detect(picture(at), {}, here, UP)
    assert set(tracker.detect(picture(at, 5), here, {}, UP).feet) == {"left"}
    assert tracker.detect(picture({}, 5), here, {}, UP).refused == {"left": "hidden"}
    far: dict[Side, Float] = {"left": position(-0.12, 0.085, 0.9)}
    assert not tracker.detect(picture(far, 5), {"left": expected(at["left"], 0.02)}, {}, UP).feet
    behind: dict[Side, FootPrediction] = {"left": expected(np.array([0.0, 0.0, -1.0]))}
    assert tracker.detect(picture(at), behind, {}, UP).refused == {"left": "hidden"}
    blind = DepthFrame(0, background(CAMERA), None, CAMERA, 0)
    assert not tracker.detect(blind, here, {}, UP).feet
