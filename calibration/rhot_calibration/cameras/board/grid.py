"""Chessboard corners of one picture as a grid: finding, refining, ordering, and looking past its edges.

A grid is (rows, columns, 2) float64, pixels, raw image; `grid[i, j]` is the corner in row i and column j.
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterator
from typing import Final

import cv2
import numpy as np
from numpy.typing import NDArray

from rhot.arrays import FloatArray
from rhot.errors import CalibrationError
from rhot_calibration.cameras.solve.views import Board

# Calibration boards as people state them: `9x6` inner corners of so many millimetres.

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


GrayImage = NDArray[np.uint8]

MIN_SIDE_PX: Final = 32  # OpenCV's finder fails below about 11 pixels
WORKING_SIDE_PX: Final = 1600  # the finder takes seconds on larger pictures; corners are refined in the original

# Half a window of cornerSubPix as a share of the shortest distance between corners. Measured on drawn boards with
# blur and noise: 0.2 leaves 0.10 px RMS, 0.3 leaves 0.07 px; on the bowed real board the scatter grows from 0.35 on.
_WINDOW_SHARE: Final = 0.3
_REFINING: Final = (cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_COUNT, 50, 1e-3)

_MIN_CONTRAST: Final = 8.0  # grey levels between a dark and a light square
# Mean of the squares' colours against the pattern, 1 = as a board; the rim may lie under the fingers that hold it.
_CONTINUES: Final = 0.6
_RIM: Final = 0.4
_MAX_EXTRA: Final = 12


def find_grid(gray: GrayImage, columns: int, rows: int) -> FloatArray | None:
    """Return the refined grid of a chessboard of that many inner corners, in OpenCV's order; None = not found.

    The classic finder with `cornerSubPix` comes first, the sector-based one (Duda and Frese 2018, OpenCV's SB) helps
    out where it fails. On drawn boards with known corners the classic pair leaves 0.07 px RMS; the sector-based one
    leaves 0.05 px on large squares but is off by up to 0.7 px on squares under 20 px, so its corners are refined too.
    """
    if is_blank(gray):
        return None
    scale = max(gray.shape) / WORKING_SIDE_PX
    if scale > 1.0:
        small = cv2.resize(gray, None, fx=1.0 / scale, fy=1.0 / scale, interpolation=cv2.INTER_AREA)
        ratio = np.array([gray.shape[1] / small.shape[1], gray.shape[0] / small.shape[0]])
        for grid in _candidates(np.asarray(small, dtype=np.uint8), columns, rows):
            refined = refine(gray, (grid + 0.5) * ratio - 0.5)
            if _alternates(gray, refined):
                return refined
    for grid in _candidates(gray, columns, rows):
        refined = refine(gray, grid)
        if _alternates(gray, refined):
            return refined
    return None


def is_blank(gray: GrayImage) -> bool:
    """Tell whether a picture is too small or too even to show any board."""
    return min(gray.shape) < MIN_SIDE_PX or int(gray.max()) - int(gray.min()) < 2.0 * _MIN_CONTRAST


def _candidates(gray: GrayImage, columns: int, rows: int) -> Iterator[FloatArray]:
    flags = cv2.CALIB_CB_ADAPTIVE_THRESH | cv2.CALIB_CB_NORMALIZE_IMAGE
    found, corners = cv2.findChessboardCorners(gray, (columns, rows), flags=flags)
    if found:
        yield np.asarray(corners, dtype=np.float64).reshape(rows, columns, 2)
    found, corners = cv2.findChessboardCornersSB(gray, (columns, rows), flags=cv2.CALIB_CB_EXHAUSTIVE)
    if found:
        yield np.asarray(corners, dtype=np.float64).reshape(rows, columns, 2)


def _alternates(gray: GrayImage, grid: FloatArray) -> bool:
    """Tell whether squares are dark and light in turn; a finder told of a small board may return every other corner."""
    values = _squares(gray, grid)
    sign = np.where(np.add.outer(np.arange(values.shape[0]), np.arange(values.shape[1])) % 2 == 0, 1.0, -1.0)
    steps = np.concatenate(
        [(sign[:, :-1] * np.diff(values, axis=1)).ravel(), (sign[:-1] * np.diff(values, axis=0)).ravel()]
    )
    right = float((np.sign(np.median(steps)) * steps > _MIN_CONTRAST).mean())
    alternating = 0.9
    return right >= alternating


def refine(gray: GrayImage, grid: FloatArray) -> FloatArray:
    """Return a grid refined to a fraction of a pixel; the window follows the size of the squares."""
    min_window_px = 3
    max_window_px = 15
    half = int(np.clip(_WINDOW_SHARE * spacing_px(grid), min_window_px, max_window_px))
    start = np.ascontiguousarray(grid.reshape(-1, 1, 2), dtype=np.float32)
    refined = cv2.cornerSubPix(gray, start, (half, half), (-1, -1), _REFINING)
    return np.asarray(refined, dtype=np.float64).reshape(grid.shape)


def spacing_px(grid: FloatArray) -> float:
    """Return the shortest distance between neighbouring corners."""
    return min(float(np.linalg.norm(np.diff(grid, axis=axis), axis=2).min()) for axis in (0, 1))


def oriented(gray: GrayImage, grid: FloatArray) -> FloatArray:
    """Return the grid in the order of a board that is seen from its printed face and whose first square is dark.

    Columns × rows is right-handed in the picture (x right, y down). Where half a turn (or, on boards with as many
    rows as columns, a quarter) leaves the colours alone, the row direction that points most to the right wins.
    """
    along, down = grid[0, -1] - grid[0, 0], grid[-1, 0] - grid[0, 0]
    if along[0] * down[1] - along[1] * down[0] < 0.0:
        grid = grid[:, ::-1]
    turns = (0, 1, 2, 3) if grid.shape[0] == grid.shape[1] else (0, 2)
    candidates = [np.rot90(grid, turn) for turn in turns]
    dark_first = [candidate for candidate in candidates if _levels(gray, candidate)[0] < _levels(gray, candidate)[1]]
    return max(dark_first or candidates, key=lambda one: float((one[:, -1] - one[:, 0])[:, 0].sum()))


def extra_corners(gray: GrayImage, grid: FloatArray) -> tuple[int, int]:
    """Return how many columns and rows of corners the board goes on by outside the grid; (0, 0) = it is the whole.

    A finder told of a smaller board than the real one may return a part of it. The squares two steps outside the
    outermost corners are then squares again, dark and light in turn; outside a whole board they are its white margin.
    Negative: told of a larger board, it took the board's edge for corners; even one step outside is white margin.
    """
    left, right = (_extra_columns(gray, side) for side in (grid[:, ::-1], grid))
    across = np.swapaxes(grid, 0, 1)
    top, bottom = (_extra_columns(gray, side) for side in (across[:, ::-1], across))
    return left + right, top + bottom


def _extra_columns(gray: GrayImage, grid: FloatArray) -> int:
    """Return how many columns follow the last, −1 = not even that is one; by the homography of the nearest three."""
    rows, columns = grid.shape[:2]
    first, second = _levels(gray, grid)
    near = np.array([(j, i) for i in range(rows) for j in range(columns - 3, columns)], dtype=np.float64)
    H, _ = cv2.findHomography(near, grid[:, -3:].reshape(-1, 2))
    squares = np.arange(-1, rows)
    for extra in range(-1, _MAX_EXTRA):
        centers = np.column_stack([np.full(squares.size, columns + extra + 0.5), squares + 0.5])
        pixels = cv2.perspectiveTransform(centers[None], H)[0]
        inside = ((pixels > 0.0) & (pixels < np.array(gray.shape[::-1]) - 1.0)).all(axis=1)
        if 2 * inside.sum() < squares.size or inside.sum() < 3:
            return max(extra, 0)
        value = (_sample(gray, pixels[inside]) - 0.5 * (first + second)) / (0.5 * (first - second))
        sign = np.where((squares[inside] + columns + extra) % 2 == 0, 1.0, -1.0)
        if float(np.mean(sign * np.clip(value, -1.0, 1.0))) < (_RIM if extra < 0 else _CONTINUES):
            return extra
    return _MAX_EXTRA


def _levels(gray: GrayImage, grid: FloatArray) -> tuple[float, float]:
    """Return the mean grey of the inner squares of the first one's colour, and of the others."""
    values = _squares(gray, grid)
    even = np.add.outer(np.arange(values.shape[0]), np.arange(values.shape[1])) % 2 == 0
    return float(values[even].mean()), float(values[~even].mean())


def _squares(gray: GrayImage, grid: FloatArray) -> FloatArray:
    """Return the grey levels (rows − 1, columns − 1) in the middle of the inner squares."""
    centers = 0.25 * (grid[:-1, :-1] + grid[1:, :-1] + grid[:-1, 1:] + grid[1:, 1:])
    return _sample(gray, centers.reshape(-1, 2)).reshape(grid.shape[0] - 1, grid.shape[1] - 1)


def _sample(gray: GrayImage, pixels: FloatArray) -> FloatArray:
    """Return grey levels (N,) at pixels (N, 2), bilinear."""
    maps = pixels.astype(np.float32).reshape(-1, 1, 2)
    values = cv2.remap(gray, maps[..., 0], maps[..., 1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    return np.asarray(values, dtype=np.float64).ravel()
