"""Whole worlds: reproducible, possible and in view; and the files of their truth."""

from __future__ import annotations

import csv
import gzip
import json
from pathlib import Path

import numpy as np
import pytest

from worlds.contact import least_gap, object_gap
from worlds.hand import MARKERS, joint_positions, marker_positions
from worlds.look import lab
from worlds.motion import fastest_tip
from worlds.skin import make_skin, with_patch
from worlds.truth import Seen, write_fixed, write_seen
from worlds.world import COUNTS, World, is_possible, make_world, random_grasp, random_hand


@pytest.fixture(scope="module")
def world() -> World:
    return make_world(2)


def times(world: World, sequence: str, step_ns: float = 5e6) -> np.ndarray:
    timing = world.timings[sequence]
    return np.arange(timing.first_ns, timing.end_ns, step_ns)


def test_a_seed_tells_all(world: World) -> None:
    again = make_world(2)
    t_ns = times(world, "G2")
    np.testing.assert_array_equal(again.states("G2", t_ns).bones, world.states("G2", t_ns).bones)
    np.testing.assert_array_equal(again.cameras["right"].K, world.cameras["right"].K)
    assert again.look.paints == world.look.paints
    assert make_world(3).hand.length_mm != world.hand.length_mm


def test_joints_keep_to_human_limits(world: World) -> None:
    for sequence in ("G1", "G2", "K"):
        track = world.states(sequence, times(world, sequence))
        assert track.angles.min() > -15.0
        assert track.angles.max() < 105.0


def test_fingers_pass_neither_through_each_other_nor_through_the_object(world: World) -> None:
    assert least_gap(world.hand, world.states("G1", times(world, "G1"))) > -1.5
    motion = world.states("G2", times(world, "G2"))
    assert motion.T_world_object is not None
    assert object_gap(world.hand, motion, world.grasp.solid, motion.T_world_object).min() > -2.0


def test_the_object_stands_until_it_is_held_and_is_carried(world: World) -> None:
    motion = world.states("G2", times(world, "G2"))
    assert motion.T_world_object is not None
    at = motion.T_world_object[:, :3, 3]
    held = (motion.t_s > world.grasp.held_s[0]) & (motion.t_s < world.grasp.held_s[1])
    assert np.ptp(at[motion.t_s < world.grasp.held_s[0]], axis=0).max() < 1e-9
    assert at[held][:, 2].max() > at[0, 2] + 20.0
    assert np.linalg.norm(at[-1, :2] - at[0, :2]) > 80.0
    assert at[-1, 2] == pytest.approx(at[0, 2], abs=2.0)


def test_gestures_are_fast_and_in_view(world: World) -> None:
    span_s = (world.timings["G1"].end_ns - world.timings["G1"].first_ns) * 1e-9
    assert 700.0 <= fastest_tip(world.hand, world.gestures, span_s) <= 1200.0
    for sequence in ("G1", "G2", "K"):
        at = marker_positions(world.hand, world.states(sequence, times(world, sequence)).bones)
        for camera in world.cameras.values():
            pixels = camera.project(at)
            assert pixels.min() > 0.0
            assert (pixels < np.array([639.0, 479.0])).all()


def test_paints_are_told_apart(world: World) -> None:
    colours = np.array([lab(paint.colour) for paint in world.look.paints.values()])
    apart = np.linalg.norm(colours[:, None] - colours[None], axis=-1) + 1e3 * np.eye(6)
    assert apart.min() > 30.0


def test_files_of_the_truth_agree_with_each_other(world: World, tmp_path: Path) -> None:
    skin = make_skin(world.hand)
    write_fixed(world, skin, tmp_path)
    cameras, frames = world.timings["K"], {}
    for camera in world.cameras:
        frames[camera, 0] = [Seen(100.0, (10.0, 20.0), (1.0, 2.0, 3.0, 4.0)), *[Seen(0.0)] * 5]
    write_seen(world, skin, "K", frames, tmp_path)
    calib = json.loads((tmp_path / "calib.json").read_text())
    with gzip.open(tmp_path / "K" / "truth_500hz.csv.gz", "rt") as file:
        first = next(iter(csv.DictReader(file)))
    rows = list(csv.DictReader((tmp_path / "K" / "truth_frames.csv").open()))
    assert [row["marker"] for row in rows] == list(MARKERS) * 2
    R, T, K = (np.array(value) for value in (calib["R"], calib["T"], calib["right"]["K"]))
    for row in rows:
        at = np.array([float(row[axis]) for axis in "xyz"])
        np.testing.assert_allclose(at, [float(first[f"{row['marker']}_{axis}"]) for axis in "xyz"], atol=2e-3)
        if row["cam"] == "right":
            seen = K @ (R @ at + T)
            # Without distortion, which is small: only that the frames agree.
            assert np.hypot(*(seen[:2] / seen[2] - [float(row["u"]), float(row["v"])])) < 12.0
    assert rows[0]["vis_u"] == "10.00"
    assert rows[1]["visible_frac"] == "0.000"
    assert rows[1]["vis_u"] == ""
    assert cameras.count == COUNTS["K"]


def test_visible_paint_is_measured_by_its_share_of_each_pixel() -> None:
    coverage = np.zeros((480, 640))
    coverage[10:12, 20:24] = 1.0
    coverage[12, 20:24] = 0.5
    seen = Seen.of(coverage)
    assert seen.area == pytest.approx(10.0)
    assert seen.centroid == pytest.approx((21.5, (4 * 10 + 4 * 11 + 2 * 12) / 10))
    assert seen.box == (20.0, 10.0, 24.0, 13.0)
    assert Seen.of(np.zeros((480, 640))) == Seen(0.0)


def test_joints_of_the_grasp_stay_above_the_desk(world: World) -> None:
    joints = joint_positions(world.hand, world.states("G2", times(world, "G2")).bones)
    assert joints[..., 2].min() > 0.0


@pytest.mark.parametrize("kind", ["ring", "handle"])
def test_fingers_close_round_a_bar(kind: str) -> None:
    rng = np.random.default_rng(3)
    hand = with_patch(random_hand(rng), rng)
    grasps = (random_grasp(rng, hand, 2.4, kind) for _ in range(30))
    grasp = next(grasp for grasp in grasps if grasp is not None and is_possible(hand, grasp, 2.4))
    held = grasp.states(hand, np.array([1.4]))
    assert held.T_world_object is not None
    gaps = object_gap(hand, held, grasp.solid, held.T_world_object)[0, 1:5]
    assert (gaps < 2.0).sum() >= 2
    assert gaps.min() > -1.2
