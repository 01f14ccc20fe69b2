from __future__ import annotations

from collections.abc import Mapping

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from rhot.geometry.rotations import rotation_x, rotation_y
from rhot_calibration.cameras.live.coverage import (
    WANTED_SHARED,
    WANTED_VIEWS,
    camera_coverage,
    links,
    similar,
    tilt_deg,
    unlinked,
)
from rhot_calibration.cameras.solve.views import Board, BoardView, ViewSet

BOARD = Board(9, 6, 0.025)
SIZE = (640, 480)
K = np.array([[530.0, 0.0, 319.5], [0.0, 530.0, 239.5], [0.0, 0.0, 1.0]])
UPRIGHT = np.eye(3)


def view(u: float, v: float, distance_m: float = 0.5, R: NDArray[np.float64] = UPRIGHT) -> BoardView:
    """Return the board with its middle at a pixel, turned by R about its middle as seen along the middle's ray."""
    middle = distance_m * np.array([(u - K[0, 2]) / K[0, 0], (v - K[1, 2]) / K[1, 1], 1.0])
    t = middle - R @ BOARD.points.mean(axis=0)
    pixels, _ = cv2.projectPoints(BOARD.points, cv2.Rodrigues(R)[0], t, K, None)
    return BoardView(np.arange(54), np.asarray(pixels, np.float64).reshape(-1, 2))


def view_set(views: Mapping[tuple[str, int], BoardView], cameras: tuple[str, ...] = ("left",)) -> ViewSet:
    return ViewSet(BOARD, dict.fromkeys(cameras, SIZE), views, {})


def numbered(*views: BoardView) -> ViewSet:
    return view_set({("left", number): one for number, one in enumerate(views)})


@pytest.mark.parametrize(
    ("R", "expected_deg"),
    [
        (UPRIGHT, (0.0, 0.0)),
        # Turned about y (down) by a positive angle, the right edge comes nearer.
        (rotation_y(np.radians(-30.0)), (30.0, 0.0)),
        (rotation_y(np.radians(30.0)), (-30.0, 0.0)),
        (rotation_x(np.radians(30.0)), (0.0, 30.0)),
        (rotation_x(np.radians(-30.0)), (0.0, -30.0)),
    ],
)
def test_tilt_is_told_by_the_edge_that_is_further_away(
    R: NDArray[np.float64], expected_deg: tuple[float, float]
) -> None:
    # The true focal length is 530 px, the nominal one 544 px.
    np.testing.assert_allclose(tilt_deg(BOARD, view(319.5, 239.5, R=R), SIZE), expected_deg, atol=1.0)


def test_without_views_the_board_is_to_be_shown() -> None:
    assert camera_coverage(view_set({}))["left"].missing == ("show it the board",)
    assert camera_coverage(view_set({}))["left"].share == 0.0


def test_one_view_covers_its_own_part_of_the_picture() -> None:
    coverage = camera_coverage(numbered(view(150.0, 110.0)))["left"]
    assert coverage.area[:4, :5].mean() > 0.5
    assert not coverage.area[5:].any()
    assert not coverage.area[:, 6:].any()
    # 8 by 5 squares of 26.5 px, from (44, 44) to (256, 176): 5 by 4 cells of 53.3 px.
    assert coverage.area_share == pytest.approx(20 / 108)
    assert coverage.fills[0] == pytest.approx(212.0 / 640.0, abs=1e-6)
    assert not any("upper left" in sentence for sentence in coverage.missing)
    assert any("lower right corner" in sentence for sentence in coverage.missing)


def spread() -> list[BoardView]:
    """Views all over the picture, tilted to all four sides."""
    turns = [rotation_y(a) @ rotation_x(b) for a, b in ((-0.5, 0.0), (0.5, 0.0), (0.0, 0.5), (0.0, -0.5))]
    places = [(u, v) for v in (90.0, 240.0, 390.0) for u in (125.0, 320.0, 515.0)]
    return [view(u, v, 0.5, turns[number % 4]) for number, (u, v) in enumerate([*places, *places])]


def test_well_spread_views_are_enough() -> None:
    coverage = camera_coverage(numbered(*spread()))["left"]
    assert coverage.missing == ()
    assert coverage.share == 1.0


def centred(other: BoardView, distance_m: float) -> BoardView:
    """Return an untilted view in the middle of another."""
    u, v = other.corners.mean(axis=0)
    return view(float(u), float(v), distance_m)


def test_each_lack_is_named_alone() -> None:
    views = spread()
    few = camera_coverage(numbered(*views[: WANTED_VIEWS - 3]))["left"].missing
    assert few == ("3 more views",)
    flat = camera_coverage(numbered(*(centred(one, 0.5) for one in views)))["left"].missing
    assert len(flat) == 4
    assert all("tilt" in sentence for sentence in flat)
    far = camera_coverage(numbered(*(centred(one, 1.2) for one in views)))["left"].missing
    assert any("nearer" in sentence for sentence in far)


def test_views_near_each_other_are_similar() -> None:
    first = view(300.0, 200.0)
    assert similar(first, view(310.0, 205.0), 640)
    assert not similar(first, view(330.0, 200.0), 640)
    assert not similar(first, view(300.0, 200.0, 0.7), 640)
    assert not similar(first, view(300.0, 200.0, 0.5, rotation_y(1.0)), 640)


def test_cameras_are_tied_by_a_chain_of_enough_shared_pictures() -> None:
    one = view(300.0, 200.0)
    ab = {(camera, number): one for number in range(WANTED_SHARED) for camera in ("a", "b")}
    bc = {(camera, 100 + number): one for number in range(WANTED_SHARED) for camera in ("b", "c")}
    cameras = ("a", "b", "c")
    assert links(view_set(ab | bc, cameras)) == {("a", "b"): WANTED_SHARED, ("a", "c"): 0, ("b", "c"): WANTED_SHARED}
    assert unlinked(view_set(ab | bc, cameras)) == []
    assert unlinked(view_set(ab, cameras)) == [("a", "b"), ("c",)]
    del bc["c", 100]
    assert unlinked(view_set(ab | bc, cameras)) == [("a", "b"), ("c",)]


def test_views_of_few_corners_count_for_nothing() -> None:
    full = view(300.0, 200.0)
    few = BoardView(full.ids[:4], full.corners[:4])
    views = view_set({(camera, number): few for number in range(9) for camera in ("a", "b")}, ("a", "b"))
    assert links(views) == {("a", "b"): 0}
    assert camera_coverage(views)["a"].views == 0
