from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest
from boards.pictures import board_picture

from rhot_calibration.cameras.board.detect import detect_board, looks_mirrored, seen_dictionary, wrong_count_hint
from rhot_calibration.cameras.board.grid import GrayImage, parse_board
from rhot_calibration.cameras.solve.views import Board

CHESSBOARD = parse_board("9x6", 0.025)
CHARUCO = parse_board("9x6", 0.025, 0.018)


def real_picture(shared_data: Path, side: str, number: int) -> GrayImage:
    file = shared_data / "thesis_rig" / "chessboard" / side / f"{number:06d}.jpg"
    return np.asarray(cv2.imread(str(file), cv2.IMREAD_GRAYSCALE), dtype=np.uint8)


@pytest.mark.parametrize("board", [CHESSBOARD, CHARUCO], ids=["chessboard", "charuco"])
@pytest.mark.parametrize("size", [(640, 480), (2592, 1944)])
@pytest.mark.parametrize("turn_deg", [0.0, 90.0, 180.0, -60.0])
def test_corners_and_their_order(board: Board, size: tuple[int, int], turn_deg: float) -> None:
    picture, corners = board_picture(board, size=size, tilt_deg=(15.0, -20.0, turn_deg))
    view = detect_board(picture, board)
    assert view is not None
    assert len(view.ids) == 54 or board.is_charuco
    off = np.linalg.norm(view.corners - corners[view.ids], axis=1)
    assert np.sqrt((off**2).mean()) < 0.12
    assert off.max() < 0.35
    assert 1.0 < view.sharpness < 4.0


@pytest.mark.parametrize("counts", ["7x7", "6x6", "8x6"])
def test_boards_without_a_first_corner_are_read_from_the_left(counts: str) -> None:
    board = parse_board(counts, 0.025)
    picture, corners = board_picture(board, tilt_deg=(10.0, 15.0, 30.0))
    view = detect_board(picture, board)
    assert view is not None
    np.testing.assert_allclose(view.corners, corners, atol=0.4)


def test_blur_raises_the_edge_width() -> None:
    sharp, _ = board_picture(CHESSBOARD)
    blurred = np.asarray(cv2.GaussianBlur(sharp, (0, 0), 2.0), dtype=np.uint8)
    first, second = detect_board(sharp, CHESSBOARD), detect_board(blurred, CHESSBOARD)
    assert first is not None
    assert second is not None
    # 10 to 90 % of a Gaussian edge are 2.56 sigma.
    assert second.sharpness == pytest.approx(np.hypot(first.sharpness, 2.56 * 2.0), rel=0.15)


def test_all_real_chessboards_are_found(shared_data: Path) -> None:
    for side in ("left", "right"):
        for number in range(1, 16):
            view = detect_board(real_picture(shared_data, side, number), CHESSBOARD)
            assert view is not None, f"{side} {number}"
            grid = view.corners.reshape(6, 9, 2)
            along, down = grid[0, -1] - grid[0, 0], grid[-1, 0] - grid[0, 0]
            assert along[0] * down[1] - along[1] * down[0] > 0.0


@pytest.mark.parametrize("counts", ["8x6", "8x5", "9x5", "9x7", "5x4"])
def test_a_wrong_count_is_noticed_and_named_on_real_pictures(shared_data: Path, counts: str) -> None:
    board = parse_board(counts, 0.0259)
    for side, number in (("left", 2), ("right", 15)):
        picture = real_picture(shared_data, side, number)
        assert detect_board(picture, board) is None
        assert wrong_count_hint(picture, board) == (9, 6)


def test_a_wrong_count_of_a_charuco_board_is_named() -> None:
    picture, _ = board_picture(CHARUCO)
    stated = parse_board("8x6", 0.025, 0.018)
    assert detect_board(picture, stated) is None
    assert wrong_count_hint(picture, stated) == (9, 6)
    assert wrong_count_hint(picture, CHARUCO) is None


def test_nothing_is_found_where_nothing_is(shared_data: Path) -> None:
    photo = cv2.imread(
        str(shared_data / "thesis_rig" / "photos" / "GOPR0442.MP4.Standbild001.jpg"), cv2.IMREAD_GRAYSCALE
    )
    for picture in (np.asarray(photo, dtype=np.uint8), np.zeros((4, 4), np.uint8), np.full((480, 640), 9, np.uint8)):
        for board in (CHESSBOARD, CHARUCO):
            assert detect_board(picture, board) is None
            assert wrong_count_hint(picture, board) is None
            assert not looks_mirrored(picture, board)


def test_a_mirrored_charuco_board_is_told_from_a_right_one() -> None:
    picture, _ = board_picture(CHARUCO)
    mirrored = np.ascontiguousarray(picture[:, ::-1])
    assert detect_board(mirrored, CHARUCO) is None
    assert looks_mirrored(mirrored, CHARUCO)
    assert not looks_mirrored(picture, CHARUCO)


def test_a_partly_hidden_charuco_board_keeps_its_numbers() -> None:
    picture, corners = board_picture(CHARUCO, tilt_deg=(10.0, -15.0, 5.0))
    picture[:, 320:] = 90
    view = detect_board(picture, CHARUCO)
    assert view is not None
    assert 6 <= len(view.ids) < 40
    assert np.abs(view.corners - corners[view.ids]).max() < 0.4


def test_charuco_corners_on_one_line_are_refused() -> None:
    picture, corners = board_picture(CHARUCO, tilt_deg=(0.0, 0.0, 0.0))
    below = int(corners[12, 1] - 0.5 * (corners[9, 1] - corners[0, 1])) + 14
    picture[below + 8 :] = 90
    view = detect_board(picture, CHARUCO)
    assert view is None or len({int(number) // 9 for number in view.ids}) > 1


@pytest.mark.parametrize(
    ("dictionary", "numbers", "smallest"),
    [
        ("DICT_6X6_250", (1, 2, 3, 4), "DICT_6X6_50"),
        ("DICT_6X6_250", (10, 20, 60, 70, 150, 200), "DICT_6X6_250"),
        ("DICT_6X6_250", (1, 2, 3, 200), "DICT_6X6_250"),
        ("DICT_APRILTAG_36H11", (1, 2, 3, 400), "DICT_APRILTAG_36H11"),
    ],
)
def test_the_dictionary_is_the_smallest_that_has_all_markers(
    dictionary: str, numbers: tuple[int, ...], smallest: str
) -> None:
    markers = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, dictionary))
    tiles = [np.pad(markers.generateImageMarker(number, 80), 20, constant_values=255) for number in numbers]
    assert seen_dictionary(np.hstack(tiles)) == (smallest, len(numbers))
