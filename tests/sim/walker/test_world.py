"""The walking person's world: what the pictures show is what is true, whoever asks and whenever."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from rhot.anatomy.body_proportions import BodyModel
from rhot.arrays import FloatArray
from rhot.aruco_dictionary import marker_corners_m, marker_dictionary
from rhot.errors import ConfigError
from rhot.messages import Side, Truth, decode, encode
from rhot.rig import BodyConfig, load_rig
from rhot_sim.walker.folder import write_walker_rig
from rhot_sim.walker.foot_path import SIDES
from rhot_sim.walker.person import person_of
from rhot_sim.walker.pictures.camera import DELAY_S
from rhot_sim.walker.pictures.depth import DISPARITY_SIGMA_PX
from rhot_sim.walker.pictures.disturbances import Cover, Disturbances
from rhot_sim.walker.world import WalkerWorld
from rhot_sim.world.world import World

Image = NDArray[np.uint8]
BARE = Disturbances(hems=False)
MARKERS: dict[Side, int] = {"left": 0, "right": 1}


def detector(markers: int) -> cv2.aruco.ArucoDetector:
    dictionary = marker_dictionary("3X3_32")
    worn = cv2.aruco.Dictionary(dictionary.bytesList[:markers], dictionary.markerSize, 0)
    parameters = cv2.aruco.DetectorParameters()
    parameters.cornerRefinementMethod = cv2.aruco.CORNER_REFINE_SUBPIX
    parameters.cornerRefinementWinSize = 3
    parameters.minMarkerPerimeterRate = 0.02
    return cv2.aruco.ArucoDetector(worn, parameters)


def found(picture: Image, markers: int = 2) -> dict[int, list[FloatArray]]:
    """Corners (4, 2) of all markers in a picture by their number, of the first so many of the dictionary."""
    corners, ids, _ = detector(markers).detectMarkers(picture)
    seen: dict[int, list[FloatArray]] = {}
    for number, quad in zip([] if ids is None else ids.ravel(), corners, strict=True):
        seen.setdefault(int(number), []).append(quad[0].astype(np.float64))
    return seen


def true_corners(world: WalkerWorld, side: Side, t_s: float) -> FloatArray:
    T = world.feet(np.array([t_s]))[side][0]
    return world.project(marker_corners_m(0.06) @ T[:3, :3].T + T[:3, 3], t_s)


@pytest.fixture(scope="module")
def standing() -> WalkerWorld:
    return WalkerWorld(1, BodyModel.from_config(BodyConfig(height_m=1.75)), "still", disturbances=BARE)


def test_markers_are_found_where_they_are(standing: WalkerWorld) -> None:
    errors = []
    for index in range(0, 100, 20):
        t_s, color, _ = standing.frame(index)
        assert color.shape == (480, 848, 3)
        seen = found(color)
        for side, number in MARKERS.items():
            assert len(seen[number]) == 1
            errors.append(seen[number][0] - true_corners(standing, side, t_s))
    distance = np.linalg.norm(np.array(errors), axis=-1)
    assert distance.max() < 1.0
    # Corners may be off a little inwards or outwards; the marker as a whole is not.
    assert np.abs(np.array(errors).mean(axis=1)).max() < 0.15


def test_moving_markers_are_found_in_the_middle_of_their_blur(body: BodyModel) -> None:
    world = WalkerWorld(2, body, "walk", disturbances=BARE)
    errors, speeds = [], []
    for index in range(120, 420, 9):
        t_s, color, _ = world.frame(index)
        seen = found(color)
        for side, number in MARKERS.items():
            for corners in seen.get(number, []):
                errors.append(np.linalg.norm((corners - true_corners(world, side, t_s)).mean(axis=0)))
                shift = true_corners(world, side, t_s + 1e-3) - true_corners(world, side, t_s - 1e-3)
                speeds.append(np.linalg.norm(shift.mean(axis=0)) / 2e-3)
    assert len(errors) > 12
    assert max(speeds) > 150.0
    assert np.median(errors) < 0.3
    assert np.percentile(errors, 90) < 1.0


def test_feet_are_lost_from_view_while_walking(body: BodyModel) -> None:
    world = WalkerWorld(3, body, "walk", disturbances=BARE)
    t = np.arange(0.0, 30.0, 0.2)
    feet = world.feet(t)
    inside = []
    for i, t_s in enumerate(t):
        pixels = world.project(feet["left"][i, None, :3, 3], t_s)[0]
        inside.append(bool((pixels >= 0.0).all() and (pixels < (848.0, 480.0)).all()))
    assert 0.4 < np.mean(inside) < 0.95


def test_floor_and_marker_have_the_depth_and_the_noise_of_the_model(standing: WalkerWorld) -> None:
    T = (standing.head(np.array([standing.timing(0).t_s])) @ standing.T_head_camera)[0]
    K = standing.intrinsics
    depths = []
    for index in range(0, 48, 6):
        t_s, _, depth = standing.frame(index)
        T = (standing.head(np.array([t_s])) @ standing.T_head_camera)[0]
        # The middle of two by two pixels that share a value, in the upper half, where there is only floor.
        v, u = np.mgrid[0:200:2, 0:848:2] + 0.5
        rays = np.stack([(u - K[0, 2]) / K[0, 0], (v - K[1, 2]) / K[1, 1], np.ones(u.shape)], axis=-1)
        true = T[1, 3] / -(rays @ T[1, :3])
        depths.append((depth[0:200:2, 0:848:2] / 1000.0, true))
    measured, true = (np.array(each) for each in zip(*depths, strict=True))
    valid = measured > 0.0
    assert valid.mean() > 0.98
    error = np.where(valid, measured - true, np.nan)
    sigma = true**2 * DISPARITY_SIGMA_PX / (423.752 * 0.050)
    assert abs(np.nanmean(error)) < 0.001
    assert np.nanstd(error / sigma) == pytest.approx(1.0, abs=0.15)
    # Neighbours and frames share part of it: averaging does not help as much as with independent noise.
    assert np.nanstd(np.nanmean(error / sigma, axis=0)) > 0.5

    t_s, _, depth = standing.frame(1)
    T = (standing.head(np.array([t_s])) @ standing.T_head_camera)[0]
    for side in SIDES:
        foot = standing.feet(np.array([t_s]))[side][0]
        u_px, v_px = (round(float(each)) for each in true_corners(standing, side, t_s).mean(axis=0))
        patch = depth[v_px - 6 : v_px + 7, u_px - 6 : u_px + 7]
        true_m = ((foot[:3, 3] - T[:3, 3]) @ T[:3, :3])[2]
        assert np.median(patch[patch > 0]) / 1000.0 == pytest.approx(true_m, abs=0.012)


def test_depth_without_noise_is_the_nearest_surface(body: BodyModel) -> None:
    world = WalkerWorld(1, body, "still", disturbances=BARE, noise=0.0)
    t_s, _, depth = world.frame(0)
    T = (world.head(np.array([t_s])) @ world.T_head_camera)[0]
    sample = world.person.sample(np.array([t_s]))
    ray_points = 0
    for side in SIDES:
        # A ray to the middle of the shank meets its cloth the cone's radius earlier, measured across the bone.
        knee, ankle = sample.legs[side].knee[0], sample.ankles[side][0, :3, 3]
        middle = (knee + ankle) / 2.0
        pixels = world.project(middle[None], t_s)[0]
        if not (0 <= pixels[0] < 848 and 0 <= pixels[1] < 480):
            continue
        z_m = depth[int(pixels[1]), int(pixels[0])] / 1000.0
        hit = T[:3, :3] @ (np.linalg.inv(world.intrinsics) @ [*pixels, 1.0] * z_m) + T[:3, 3]
        axis = (knee - ankle) / np.linalg.norm(knee - ankle)
        offset = (hit - ankle) - ((hit - ankle) @ axis) * axis
        assert 0.03 < np.linalg.norm(offset) < 0.06
        ray_points += 1
    assert ray_points > 0


def test_a_frame_is_the_same_for_everybody(body: BodyModel) -> None:
    one, two = (WalkerWorld(5, body, "sudden", disturbances=Disturbances(false_markers=True)) for _ in range(2))
    late, first = one.frame(97), one.frame(12)
    for mine, other in zip((first, late), (two.frame(12), two.frame(97)), strict=True):
        assert mine[0] == other[0]
        assert np.array_equal(mine[1], other[1])
        assert np.array_equal(mine[2], other[2])
    assert not np.array_equal(first[2], WalkerWorld(6, body, "sudden").frame(12)[2])


def test_frames_are_late_and_some_are_lost(standing: WalkerWorld) -> None:
    timings = [standing.timing(index) for index in range(2000)]
    late = np.array([timing.delivered_s - timing.t_s for timing in timings])
    assert late.min() >= DELAY_S
    assert late.max() < DELAY_S + 0.02
    assert 0.0 < np.mean([timing.dropped for timing in timings]) < 0.02
    assert np.diff([timing.t_s for timing in timings]) == pytest.approx(1.0 / 60.0)


def test_covered_markers_are_not_found_but_the_foot_stays_in_the_depth_image(body: BodyModel) -> None:
    covered = Disturbances(hems=False, covers=(Cover("right", 0.0, 1.0),))
    world = WalkerWorld(1, body, "still", disturbances=covered)
    t_s, color, depth = world.frame(20)
    assert set(found(color)) == {0}
    u, v = (round(float(each)) for each in true_corners(world, "right", t_s).mean(axis=0))
    foot = np.median(depth[v - 5 : v + 6, u - 5 : u + 6])
    beside = np.median(depth[v - 5 : v + 6, u + 60 : u + 71])
    assert 30.0 < beside - foot < 120.0
    assert set(found(world.frame(66)[1])) == {0, 1}


def test_false_markers_turn_up_where_no_foot_is(body: BodyModel) -> None:
    world = WalkerWorld(1, body, "still", disturbances=Disturbances(hems=False, false_markers=True))
    far, swapped = 0, 0
    for index in range(0, 900, 20):
        t_s, color, _ = world.frame(index)
        truth = {number: true_corners(world, side, t_s).mean(axis=0) for side, number in MARKERS.items()}
        for number, quads in found(color).items():
            for quad in quads:
                own, other = (np.linalg.norm(quad.mean(axis=0) - truth[each]) for each in (number, 1 - number))
                swapped += int(other < 5.0)
                far += int(min(own, other) > 20.0)
    assert far > 1
    assert swapped > 0


def test_truth_is_a_message_with_all_joints(standing: WalkerWorld) -> None:
    truth = decode(encode(standing.truth(1.25, 1_250_000_000)), Truth)
    assert truth.t_ns == 1_250_000_000
    assert set(truth.feet) == {"left", "right"}
    assert set(truth.body) == {
        "hips",
        *(f"{side}_{name}" for side in SIDES for name in ("hip", "knee", "ankle", "foot")),
    }
    assert truth.head is not None
    # Standing: head over hips over knees over ankles; the right foot is on the right.
    heights = [truth.head.position[1], *(truth.body[name].position[1] for name in ("hips", "left_knee", "left_ankle"))]
    assert heights == sorted(heights, reverse=True)
    assert truth.feet["right"].position[0] > 0.05
    assert truth.feet["left"].position[2] < truth.body["left_ankle"].position[2]


def test_people_of_one_height_differ(body: BodyModel) -> None:
    people = [person_of(body, seed) for seed in range(20)]
    assert {person.height_m for person in people} == {body.height_m}
    assert 0.005 < np.std([person.thigh_m for person in people]) / body.thigh_m < 0.05
    assert person_of(body, 3) == person_of(body, 3)


FEET_ALONE = """
version = 1
[feet.camera]
source = "simulated"
[feet.left]
marker_id = 3
[feet.right]
marker_id = 4
[body]
height_m = 1.6
[objects.head]
source = "simulated"
[sim]
seed = 5
walk = "on_spot"
"""


def test_a_rig_with_feet_alone_is_a_world(tmp_path: Path) -> None:
    (tmp_path / "rig.toml").write_text(FEET_ALONE)
    rig = load_rig(tmp_path)
    world = World.from_rig(rig)
    truth = world.truth(2.0, 2_000_000_000)
    walker = WalkerWorld.from_rig(rig)
    assert truth.head == walker.truth(2.0, 2_000_000_000).head
    assert truth.feet.keys() == {"left", "right"}
    assert not truth.points
    assert np.array_equal(world.sample(np.array([2.0])).objects["head"][0], walker.head(np.array([2.0]))[0])
    assert set(found(walker.frame(0)[1], 6)) == {3, 4}


def test_the_written_rig_is_complete(tmp_path: Path) -> None:
    rig = write_walker_rig(tmp_path / "rig", program="squat", seed=4, height_m=1.9, endpoint="tcp/127.0.0.1:7999")
    assert rig.config.sim.walk == "squat"
    assert rig.config.bus.connect == ("tcp/127.0.0.1:7999",)
    walker = WalkerWorld.from_rig(rig)
    assert walker.body.height_m == 1.9
    assert len(walker.imu("left", 0.0, 1.0)[0]) > 80


def test_a_rig_without_feet_has_no_walker(rig_folder: Path) -> None:
    with pytest.raises(ConfigError, match=r"no \[feet\]"):
        WalkerWorld.from_rig(load_rig(rig_folder))


@pytest.mark.parametrize(
    ("old", "new", "names"),
    [
        ("[feet.left]\nmarker_id = 3\n[feet.right]\nmarker_id = 4\n[feet.camera]", "[feet.camera]", "feet"),
        ('walk = "on_spot"', 'walk = "moonwalk"', "sim.walk"),
        ("version = 1", 'version = 1\n[cameras.left]\nsource = "v4l2"', "no marker"),
        ("version = 1", 'version = 1\n[markers.thumb]\njoint = "thumb_tip"', "no camera"),
    ],
)
def test_mistakes_in_such_a_rig_are_named(tmp_path: Path, old: str, new: str, names: str) -> None:
    text = FEET_ALONE.replace(old, new) if old in FEET_ALONE else "version = 1\n"
    (tmp_path / "rig.toml").write_text(text)
    with pytest.raises(ConfigError, match=names):
        load_rig(tmp_path)
