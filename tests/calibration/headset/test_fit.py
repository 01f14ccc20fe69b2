"""Where the camera sits on the headset: simulated persons look at a marker, with noise of head and corners."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from headset_feet.looked_at import SIZE_M, corners_of, looked_at, views_of

from rhot.arrays import FloatArray
from rhot.errors import CalibrationError
from rhot.geometry.rotations import rotation_from_vector, vector_from_rotation
from rhot.rig import Rig, load_rig
from rhot_calibration.headset.fit import camera_angles_rad, fit_headset, headset_file, judged, mounting_error
from rhot_calibration.headset.streams import HeadsetView, ViewCollector
from rhot_sim.walker.folder import write_walker_rig


@pytest.fixture(scope="module")
def rig(tmp_path_factory: pytest.TempPathFactory) -> Rig:
    path = tmp_path_factory.mktemp("rig") / "rig"
    return write_walker_rig(path, endpoint="tcp/127.0.0.1:7", seed=1, motion="headset")


def collector_of(rig: Rig, seed: int, views: Sequence[HeadsetView]) -> ViewCollector:
    assert rig.config.feet is not None
    collector = ViewCollector(rig.config.feet)
    collector.camera, collector.views = looked_at(seed)[1], list(views)
    return collector


def test_the_pose_is_found_from_eight_persons_as_well_as_it_says() -> None:
    """What feet need: no more than the head's own noise, 0.1 degrees, so that a foot at 1.5 m is off by 2 to 3 mm."""
    distances, rotations_deg, positions_mm, feet_mm = [], [], [], []
    for seed in range(1, 9):
        world, camera = looked_at(seed)
        fit = fit_headset(views_of(seed), camera, SIZE_M)
        angle_rad, distance_m = mounting_error(fit.T_head_camera, world.T_head_camera)
        rotations_deg.append(np.degrees(angle_rad))
        positions_mm.append(1e3 * distance_m)
        error = np.zeros(6)
        error[:3] = mounting_vector(fit.T_head_camera, world.T_head_camera)
        error[3:] = world.T_head_camera[:3, 3] - fit.T_head_camera[:3, 3]
        distances.append(error @ np.linalg.solve(fit.covariance[:6, :6], error))
        foot = np.array([0.0, 0.0, 1.5, 1.0])
        feet_mm.append(1e3 * float(np.linalg.norm((fit.T_head_camera - world.T_head_camera) @ foot)))
    assert np.median(rotations_deg) < 0.2 and max(rotations_deg) < 0.35
    assert np.median(positions_mm) < 4.0 and max(positions_mm) < 8.0
    assert np.median(feet_mm) < 2.5 and max(feet_mm) < 5.0
    # Chi-square of 6 degrees of freedom: mean 6, and its sum over 8 persons is below 74 in 99 of 100 cases.
    assert 20.0 < sum(distances) < 78.0


def mounting_vector(found: FloatArray, true: FloatArray) -> FloatArray:
    """The rotation vector from what was found to what is true, in the camera's axes."""
    return vector_from_rotation(found[:3, :3].T @ true[:3, :3])


def test_neither_a_wrong_guess_nor_a_camera_upside_down_matters() -> None:
    world, camera = looked_at(2)
    views = views_of(2)
    plain = fit_headset(views, camera, SIZE_M)
    guess = world.T_head_camera.copy()
    guess[:3, :3] = guess[:3, :3] @ rotation_from_vector(np.array([0.3, 2.0, -1.0]))
    other = fit_headset(views, camera, SIZE_M, guess)
    angle_rad, distance_m = mounting_error(other.T_head_camera, plain.T_head_camera)
    assert np.degrees(angle_rad) < 0.01 and distance_m < 1e-4
    # The same pictures of a camera that was mounted on its head: pixels and axes are turned by half a turn.
    middle = camera.K[:2, 2]
    turned = [replace(view, corners=2.0 * middle - view.corners) for view in views]
    upside_down = fit_headset(turned, camera, SIZE_M, world.T_head_camera)
    half_turn = plain.T_head_camera @ np.diag([-1.0, -1.0, 1.0, 1.0])
    angle_rad, distance_m = mounting_error(upside_down.T_head_camera, half_turn)
    assert np.degrees(angle_rad) < 0.02 and distance_m < 1e-3


def test_heads_that_are_told_late_are_found_out() -> None:
    fit = fit_headset(views_of(3, late_s=0.015), looked_at(3)[1], SIZE_M)
    assert 1e3 * fit.delay_s == pytest.approx(15.0, abs=3.0)
    angle_rad, _ = mounting_error(fit.T_head_camera, looked_at(3)[0].T_head_camera)
    assert np.degrees(angle_rad) < 0.35


def test_a_few_wrong_views_are_left_out(rig: Rig) -> None:
    views = views_of(4)
    rng = np.random.default_rng(4)
    for index in range(0, len(views), 12):
        views[index] = replace(views[index], corners=views[index].corners + rng.normal(0.0, 60.0, 2))
    found = judged(rig, collector_of(rig, 4, views), SIZE_M)
    angle_rad, distance_m = mounting_error(found.fit.T_head_camera, looked_at(4)[0].T_head_camera)
    assert found.left_out >= len(views) // 12 - 2
    assert np.degrees(angle_rad) < 0.35 and distance_m < 0.008
    assert any("left out" in note for note in found.notes)


def test_what_is_written_is_read_back_and_holds(rig: Rig, tmp_path: Path) -> None:
    found = judged(rig, collector_of(rig, 1, views_of(1)), SIZE_M)
    (tmp_path / "rig.toml").write_text((rig.path / "rig.toml").read_text())
    (tmp_path / "headset.json").write_text(headset_file(found).model_dump_json())
    read = load_rig(tmp_path)
    assert read.T_head_camera is not None and read.headset is not None
    np.testing.assert_allclose(read.T_head_camera, found.fit.T_head_camera, atol=2e-6)
    assert read.headset.quality["views"] == len(found.fit.deviation) - found.left_out
    assert rig.config.feet is not None
    pitch, yaw, roll = camera_angles_rad(rig.config.feet.camera.T_head_camera)
    assert np.degrees([pitch, yaw, roll]) == pytest.approx([20.0, 0.0, 0.0], abs=1e-9)


def still(views: Sequence[HeadsetView]) -> list[HeadsetView]:
    """The views nearest to one another: the head hardly moved."""
    R = views[len(views) // 2].T_rig_head[:3, :3]
    by_angle = sorted(views, key=lambda view: -float(np.trace(R.T @ view.T_rig_head[:3, :3])))
    near = by_angle[:8]
    rng = np.random.default_rng(1)
    return [replace(view, corners=view.corners + rng.normal(0.0, 0.1, (4, 2))) for view in near * 6]


@pytest.mark.parametrize(
    ("spoil", "message"),
    [
        (lambda views: views[:20], "20 views of marker 0; 40 are the least"),
        (still, "too little motion: .* (nod|turn|tilt).* it more"),
        (lambda views: views, r"contradict each other: .* black square 90 mm wide \(--size-mm\)"),
    ],
)
def test_nonsense_is_refused_with_what_to_do(rig: Rig, spoil: object, message: str) -> None:
    assert callable(spoil)
    size_m = 0.09 if "90 mm" in message else SIZE_M
    with pytest.raises(CalibrationError, match=message):
        judged(rig, collector_of(rig, 1, spoil(views_of(1))), size_m)


def test_a_marker_on_a_wall_is_refused(rig: Rig, tmp_path: Path) -> None:
    text = (rig.path / "rig.toml").read_text().replace("[feet.camera]", "[feet]\nup = [0.0, 0.0, 1.0]\n[feet.camera]")
    (tmp_path / "rig.toml").write_text(text)
    with pytest.raises(CalibrationError, match="tilted by 90° from the floor: lay it flat"):
        judged(load_rig(tmp_path), collector_of(rig, 1, views_of(1)), SIZE_M)


def test_the_marker_is_where_the_corners_say() -> None:
    world, camera = looked_at(1)
    fit = fit_headset(views_of(1), camera, SIZE_M)
    corners = corners_of(world)
    assert 1e3 * np.linalg.norm(fit.T_rig_marker[:3, 3] - corners.mean(axis=0)) < 15.0
    assert np.degrees(np.arccos(fit.T_rig_marker[1, 2])) < 3.0
