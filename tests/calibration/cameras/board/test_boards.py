from __future__ import annotations

import pytest

from rhot.errors import CalibrationError
from rhot_calibration.cameras.board.grid import charuco_board, half_turn_ambiguous, parse_board
from rhot_calibration.cameras.solve.views import Board


@pytest.mark.parametrize("text", ["9x6", " 9 X 6 ", "9×6"])
def test_counts_are_inner_corners(text: str) -> None:
    assert parse_board(text, 0.025) == Board(9, 6, 0.025)


@pytest.mark.parametrize(
    ("text", "square_m", "marker_m", "dictionary", "says"),
    [
        ("9", 0.025, None, "", "such as 9x6"),
        ("9x6x2", 0.025, None, "", "such as 9x6"),
        ("2x6", 0.025, None, "", "2 columns"),
        ("9x900", 0.025, None, "", "900 rows"),
        ("9x6", 25.0, None, "", "25000 mm"),
        ("9x6", 0.0, None, "", "0 mm"),
        ("9x6", float("nan"), None, "", "nan mm"),
        ("9x6", 0.025, 0.025, "DICT_5X5_100", "white rim"),
        ("9x6", 0.025, 0.018, "DICT_9X9_3", "DICT_5X5_100"),
        ("20x20", 0.025, 0.018, "DICT_5X5_100", "220 different markers"),
    ],
)
def test_impossible_boards_are_refused(
    text: str, square_m: float, marker_m: float | None, dictionary: str, says: str
) -> None:
    with pytest.raises(CalibrationError, match=says):
        parse_board(text, square_m, marker_m, dictionary)


@pytest.mark.parametrize(("text", "ambiguous"), [("9x6", False), ("8x6", True), ("7x5", True), ("6x9", False)])
def test_half_turn(text: str, ambiguous: bool) -> None:
    assert half_turn_ambiguous(parse_board(text, 0.025)) is ambiguous
    assert not half_turn_ambiguous(parse_board(text, 0.025, 0.018))


def test_charuco_has_one_square_more_than_corners() -> None:
    description = charuco_board(parse_board("9x6", 0.025, 0.018, "4x4_100"))
    assert description.getChessboardSize() == (10, 7)
    assert len(description.getChessboardCorners()) == 54
    with pytest.raises(CalibrationError, match="no markers"):
        charuco_board(parse_board("9x6", 0.025))
