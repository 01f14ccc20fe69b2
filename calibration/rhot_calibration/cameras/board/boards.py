"""Calibration boards as people state them: `9x6` inner corners of so many millimetres."""

from __future__ import annotations

import math
import re

import cv2

from rhot.errors import CalibrationError
from rhot_calibration.cameras.solve.views import Board

DEFAULT_DICTIONARY = "DICT_5X5_100"
MIN_CORNERS = 3
MAX_CORNERS = 60
MIN_SQUARE_M = 0.001
MAX_SQUARE_M = 1.0
MIN_MARKER_SHARE = 0.4
MAX_MARKER_SHARE = 0.95

_COUNTS = re.compile(r"\s*(\d{1,4})\s*[xX×]\s*(\d{1,4})\s*")


def parse_board(
    text: str, square_m: float, marker_m: float | None = None, dictionary: str = DEFAULT_DICTIONARY
) -> Board:
    """Return the board of `text`.

    Args:
        text: inner corners along and across, such as `9x6`; one fewer than squares each way, also of ChArUco boards.
        square_m: side of a square, metres.
        marker_m: side of a marker of a ChArUco board, metres; None = a plain chessboard.
        dictionary: OpenCV's name of the dictionary of a ChArUco board; `5x5_100` and `DICT_5X5_100` are the same.

    Raises:
        CalibrationError: not a board that can be printed and found; names the value and the limit.
    """
    counts = _COUNTS.fullmatch(text)
    if counts is None:
        raise CalibrationError(
            f"board '{text}' is not understood; write the inner corners along and across, such as 9x6 (a board of 10 "
            "by 7 squares)"
        )
    columns, rows = int(counts[1]), int(counts[2])
    for name, count in (("columns", columns), ("rows", rows)):
        if not MIN_CORNERS <= count <= MAX_CORNERS:
            raise CalibrationError(
                f"board {text}: {count} {name} of inner corners; between {MIN_CORNERS} and {MAX_CORNERS} are possible. "
                "Count the points where four squares meet, not the squares"
            )
    if not (math.isfinite(square_m) and MIN_SQUARE_M <= square_m <= MAX_SQUARE_M):
        raise CalibrationError(
            f"squares of {1e3 * square_m:g} mm: between {1e3 * MIN_SQUARE_M:g} and {1e3 * MAX_SQUARE_M:g} mm are "
            "possible; measure one side of a square (better: ten squares, divided by ten) in millimetres"
        )
    if marker_m is None:
        return Board(columns, rows, square_m)
    if not (math.isfinite(marker_m) and MIN_MARKER_SHARE * square_m <= marker_m <= MAX_MARKER_SHARE * square_m):
        raise CalibrationError(
            f"markers of {1e3 * marker_m:g} mm in squares of {1e3 * square_m:g} mm: between "
            f"{1e3 * MIN_MARKER_SHARE * square_m:g} and {1e3 * MAX_MARKER_SHARE * square_m:g} mm are possible (the "
            "marker lies inside its square, with a white rim)"
        )
    board = Board(columns, rows, square_m, marker_m, _dictionary_name(dictionary))
    needed = (columns + 1) * (rows + 1) // 2
    available = len(aruco_dictionary(board).bytesList)
    if needed > available:
        raise CalibrationError(
            f"ChArUco board {text} needs {needed} different markers, {board.dictionary} has {available}; choose a "
            "larger dictionary, such as DICT_5X5_1000, or fewer corners"
        )
    return board


def half_turn_ambiguous(board: Board) -> bool:
    """Tell whether the board looks the same after half a turn.

    A plain chessboard does when its counts of inner corners are both even or both odd: opposite corner squares then
    have the same colour. Two cameras that see such a board more than a quarter turn apart number its corners from
    opposite ends.
    """
    return not board.is_charuco and (board.columns + board.rows) % 2 == 0


def aruco_dictionary(board: Board) -> cv2.aruco.Dictionary:
    """Return the markers of a ChArUco board."""
    return cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, board.dictionary))


def charuco_board(board: Board) -> cv2.aruco.CharucoBoard:
    """Return OpenCV's description of a ChArUco board; OpenCV counts squares, one more than inner corners each way.

    Raises:
        CalibrationError: a plain chessboard.
    """
    if board.marker_m is None:
        raise CalibrationError(f"{board} has no markers; state their side to make it a ChArUco board")
    squares = (board.columns + 1, board.rows + 1)
    return cv2.aruco.CharucoBoard(squares, board.square_m, board.marker_m, aruco_dictionary(board))


def dictionary_names() -> tuple[str, ...]:
    """Return OpenCV's names of the marker dictionaries."""
    return tuple(sorted({name.upper() for name in dir(cv2.aruco) if name.startswith("DICT_")}))


def _dictionary_name(text: str) -> str:
    name = text.strip().upper()
    name = name if name.startswith("DICT_") else f"DICT_{name}"
    names = dictionary_names()
    if name not in names:
        raise CalibrationError(f"ArUco dictionary '{text}' is unknown; one of: {', '.join(names)}")
    return name
