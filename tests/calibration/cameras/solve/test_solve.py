"""Calibration of simulated rigs with known truth, and of deliberately broken sets of views."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np
import pytest
from boards.views import CAMERAS, SimulatedViews, nominal_lens, simulated_views

from rhot.arrays import FloatArray
from rhot.errors import CalibrationError
from rhot.geometry.rotations import inverse, vector_from_rotation
from rhot.rig.calibration import CameraCalibration
from rhot.rig.config import CameraConfig
from rhot.rig.folder import nominal_camera
from rhot_calibration.cameras.calibration import Calibrated, bow_mm, calibrate, cameras_file
from rhot_calibration.cameras.refusals import Expected
from rhot_calibration.cameras.solve.refusals import mirrored
from rhot_calibration.cameras.solve.solve import Solution, solve
from rhot_calibration.cameras.solve.views import Board, BoardView, ViewSet

Views = Mapping[tuple[str, int], BoardView]


def solved(simulated: SimulatedViews) -> Solution:
    return solve(simulated.views, {name: nominal_lens() for name in simulated.cameras})


def judged(views: ViewSet, expected: Expected | None = None) -> Calibrated:
    return calibrate(views, nominal(views), expected or where(views))


def nominal(views: ViewSet) -> dict[str, CameraCalibration]:
    return {name: nominal_camera(CameraConfig()) for name in views.sizes}


def where(views: ViewSet) -> Expected:
    return Expected({name: np.array([0.075 * index, 0.0, 0.0]) for index, name in enumerate(views.sizes)}, {})


def changed(simulated: SimulatedViews, views: Views) -> ViewSet:
    return replace(simulated.views, views=dict(sorted(views.items())))


def pose_errors(solution: Solution, simulated: SimulatedViews) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return errors of position (n,), mm, and of rotation (n,), degrees, and all six by their standard deviations."""
    adjusted = solution.adjusted
    places, turns, shares = [], [], []
    sd = np.sqrt(np.diag(adjusted.bundle.covariance))
    for index, name in enumerate(adjusted.cameras[1:]):
        truth, found = inverse(simulated.cameras[name].T_rig_camera), adjusted.T_camera_rig(name)
        turn = vector_from_rotation(truth[:3, :3] @ found[:3, :3].T)
        places.append(1e3 * np.linalg.norm(inverse(truth)[:3, 3] - inverse(found)[:3, 3]))
        turns.append(np.degrees(np.linalg.norm(turn)))
        start = 9 * len(adjusted.cameras) + 6 * index
        shares.append(np.concatenate([turn, truth[:3, 3] - found[:3, 3]]) / sd[start : start + 6])
    return np.array(places), np.array(turns), np.concatenate(shares)


@pytest.mark.parametrize(("cameras", "places", "seeds"), [(2, 50, 3), (4, 40, 1), (8, 50, 1)])
def test_simulated_rigs_are_found_within_their_stated_uncertainty(cameras: int, places: int, seeds: int) -> None:
    shares, mm, degrees = [], [], []
    for seed in range(1, seeds + 1):
        simulated = simulated_views(seed, cameras, places)
        solution = solved(simulated)
        assert not solution.left_out
        assert not solution.split
        assert not solution.adjusted.released, "a flat board is not to be bent"
        place, turn, share = pose_errors(solution, simulated)
        mm.append(place)
        degrees.append(turn)
        shares.append(share)
    assert np.concatenate(mm).max() < 0.3
    assert np.percentile(np.concatenate(degrees), 90) < 0.06
    inside = float(np.mean(np.abs(np.concatenate(shares)) < 2.0))
    assert inside > 0.8
    assert np.abs(np.concatenate(shares)).max() < 4.5


def test_a_bent_board_is_straightened_out() -> None:
    simulated = simulated_views(3, 2, 30, bow_m=0.004)
    solution = solved(simulated)
    adjusted = solution.adjusted
    assert adjusted.released
    assert adjusted.total_rms_px() < 0.2 < solution.flat_rms_px
    assert bow_mm(adjusted) == pytest.approx(4.0, abs=1.2)
    for name, camera in simulated.cameras.items():
        assert adjusted.lens(name)[0] == pytest.approx(camera.K[0, 0], rel=0.004)


def test_cameras_that_never_see_the_board_together_are_linked_by_a_third() -> None:
    simulated = simulated_views(5, 3, 40)
    first, _, third = simulated.views.sizes
    views = {
        (name, number): view
        for (name, number), view in simulated.views.views.items()
        if not (name == first and number % 2) and not (name == third and not number % 2)
    }
    solution = solved(replace(simulated, views=changed(simulated, views)))
    place, turn, _ = pose_errors(solution, simulated)
    assert place.max() < 1.0
    assert turn.max() < 0.15


def test_unlinked_cameras_are_named() -> None:
    simulated = simulated_views(5, 2, 24)
    views = {key: view for key, view in simulated.views.views.items() if (key[0] == "left") == (key[1] % 2 == 0)}
    with pytest.raises(CalibrationError, match=r"left \| right"):
        judged(changed(simulated, views))


def test_a_mirrored_picture_is_named_and_left_out() -> None:
    simulated = simulated_views(2, 2, 20)
    views = dict(simulated.views.views)
    views["right", 7] = mirrored(simulated.views.board, views["right", 7], 640)
    found = judged(changed(simulated, views))
    assert found.left_out == {"right/000007.png": "is mirrored; used for the lenses alone"}


def test_a_camera_that_mirrors_is_refused() -> None:
    simulated = simulated_views(2, 2, 20)
    views = {
        key: mirrored(simulated.views.board, view, 640) if key[0] == "right" else view
        for key, view in simulated.views.views.items()
    }
    with pytest.raises(CalibrationError, match="mirrored"):
        judged(changed(simulated, views))


@pytest.mark.parametrize("blurred", [6, 9])
def test_any_number_of_bad_pictures_of_one_camera_is_left_out(blurred: int) -> None:
    simulated = simulated_views(2, 2, blurred + 10)
    rng = np.random.default_rng(blurred)
    views = dict(simulated.views.views)
    bad = [("right", number) for number in range(1, 2 * blurred, 2)]
    for rank, key in enumerate(bad):
        view = views[key]
        views[key] = replace(view, corners=view.corners + (4.0 + rank) * rng.standard_normal(view.corners.shape))
    found = judged(changed(simulated, views))
    assert sorted(found.left_out) == [f"right/{number:06d}.png" for _, number in bad]


def test_swapped_pictures_are_named_and_left_out() -> None:
    simulated = simulated_views(2, 2, 20)
    views = dict(simulated.views.views)
    for number in (4, 9):
        views["left", number], views["right", number] = views["right", number], views["left", number]
    found = judged(changed(simulated, views))
    assert len(found.left_out) == 2
    assert all("swapped" in reason for reason in found.left_out.values())


def test_cameras_on_the_other_side_than_known_are_refused() -> None:
    simulated = simulated_views(2, 2, 20)
    other = {"left": "right", "right": "left"}
    views = {(other[name], number): view for (name, number), view in simulated.views.views.items()}
    with pytest.raises(CalibrationError, match=r"right stands \d+ mm left of left, rig.toml .* has it 75 mm right"):
        judged(changed(simulated, views))
    told = {"left": np.zeros(3), "right": np.array([-0.075, 0.0, 0.0])}
    assert not judged(changed(simulated, views), Expected(told, {})).warnings
    before = {name: camera.center for name, camera in simulated.cameras.items()}
    with pytest.raises(CalibrationError, match="left and right are swapped"):
        judged(changed(simulated, views), replace(where(simulated.views), previous=before))


@pytest.mark.parametrize("share", [0.5, 0.2])
def test_pictures_of_a_larger_board_are_refused_or_left_out_by_their_size(share: float) -> None:
    simulated = simulated_views(2, 2, 24)
    larger = simulated_views(2, 2, 24, board=Board(9, 6, 0.0325))
    views = {
        key: (larger if key[1] <= 24 * share else simulated).views.views[key]
        for key in simulated.views.views.keys() & larger.views.views.keys()
    }
    if share == 0.5:
        with pytest.raises(CalibrationError, match="squares of another size"):
            judged(changed(simulated, views))
        return
    found = judged(changed(simulated, views))
    assert len(found.left_out) == 4
    assert all("1.30 times as large" in reason for reason in found.left_out.values())


@pytest.mark.parametrize("angle_deg", [0.5, 2.0])
def test_a_camera_that_was_bumped_half_way_is_refused_with_the_moment(angle_deg: float) -> None:
    simulated = simulated_views(2, 2, 24)
    R = np.eye(3)
    c, s = np.cos(np.radians(angle_deg)), np.sin(np.radians(angle_deg))
    R[1:, 1:] = [[c, -s], [s, c]]
    camera = simulated.cameras["right"]
    views = dict(simulated.views.views)
    for (name, number), view in simulated.views.views.items():
        if name == "right" and number > 12:
            rays = np.column_stack([camera.undistort(view.corners), np.ones(len(view.corners))]) @ R.T
            views[name, number] = replace(
                view, corners=camera.project(rays @ camera.T_rig_camera[:3, :3].T + camera.center)
            )
    with pytest.raises(CalibrationError, match="right was moved against left between picture 12 and picture 13"):
        judged(changed(simulated, views))


def test_too_few_and_too_similar_views_are_refused() -> None:
    simulated = simulated_views(2, 2, 20)
    few = {key: view for key, view in simulated.views.views.items() if key[1] <= 4}
    with pytest.raises(CalibrationError, match="found in 4 pictures only"):
        judged(changed(simulated, few))
    noise = np.random.default_rng(1)
    same = {
        (name, number): replace(view, corners=view.corners + 0.1 * noise.standard_normal(view.corners.shape))
        for name in ("left", "right")
        for view in [simulated.views.views[name, 1]]
        for number in range(1, 16)
    }
    with pytest.raises(CalibrationError, match="differ from one another"):
        judged(changed(simulated, same))


def test_a_contradicting_baseline_is_refused_with_the_squares_that_would_fit() -> None:
    simulated = simulated_views(2, 2, 20)
    expected = replace(where(simulated.views), baseline_m=0.060)
    with pytest.raises(CalibrationError, match=r"squares would be \d\d\.\d+ mm instead of 25 mm"):
        judged(simulated.views, expected)


def test_a_board_that_half_turns_into_itself_is_numbered_from_the_right_end() -> None:
    simulated = simulated_views(4, 2, 20, board=Board(8, 6, 0.025))
    count = 8 * 6
    views = {
        key: BoardView(np.arange(count), view.corners[::-1]) if key[0] == "right" else view
        for key, view in simulated.views.views.items()
    }
    place, turn, _ = pose_errors(solved(replace(simulated, views=changed(simulated, views))), simulated)
    assert place.max() < 0.5
    assert turn.max() < 0.1


def test_expected_errors_hold_for_simulated_rigs() -> None:
    """The stated error in space is that of the true cameras, within what three rigs can tell."""
    ratios = []
    for seed in (1, 2, 3):
        simulated = simulated_views(seed, 2, 30)
        found = judged(simulated.views)
        points = np.random.default_rng(seed).uniform((-0.1, -0.1, 0.7), (0.2, 0.1, 0.8), (200, 3))
        rays = []
        for name, model in found.models.items():
            uv = simulated.cameras[name].project(points)
            xy = np.column_stack([model.undistort(uv), np.ones(len(uv))]) @ model.T_rig_camera[:3, :3].T
            rays.append((model.center, xy / np.linalg.norm(xy, axis=1, keepdims=True)))
        A = sum(np.eye(3) - d[:, :, None] * d[:, None, :] for _, d in rays)
        b = sum((np.eye(3) - d[:, :, None] * d[:, None, :]) @ c for c, d in rays)
        error = 1e3 * np.linalg.norm(np.linalg.solve(A, np.asarray(b)[..., None])[..., 0] - points, axis=1)
        ratios.append(np.sqrt(np.mean(error**2)) / found.errors[1].calibration_mm)
    assert 0.25 < np.sqrt(np.mean(np.square(ratios))) < 2.5


def test_the_file_carries_its_figures() -> None:
    simulated = simulated_views(1, 3, 24)
    found = judged(simulated.views)
    file = cameras_file(found, simulated.views)
    assert list(file.cameras) == list(CAMERAS[:3])
    assert set(file.quality["pairs"]) == {"left-right", "left-third", "right-third"}
    assert file.quality["pairs"]["left-right"]["epipolar_p95_px"] < 0.35
    assert file.quality["pairs"]["left-right"]["epipolar_p95_px_held_out"] < 0.4
    assert set(file.quality["expected_error_mm"]) == {"50 cm", "75 cm", "100 cm"}
    assert np.allclose(file.cameras["left"].T_rig_camera, np.eye(4))


def test_boards_that_are_seen_in_part_calibrate_as_well() -> None:
    """A ChArUco board's corners are known one by one, so hands and the picture's border may hide some."""
    simulated = simulated_views(6, 2, 40, board=Board(9, 6, 0.025, 0.018))
    rng = np.random.default_rng(6)
    views = {}
    for key, view in simulated.views.views.items():
        kept = np.sort(rng.permutation(54)[: rng.integers(12, 45)])
        views[key] = BoardView(view.ids[kept], view.corners[kept])
    solution = solved(replace(simulated, views=changed(simulated, views)))
    assert not solution.left_out
    place, turn, shares = pose_errors(solution, simulated)
    assert place.max() < 0.4
    assert turn.max() < 0.08
    assert np.abs(shares).max() < 4.0
