"""Finding a calibration board in one picture, and saying what else is in it when the board is not."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from typing import Final

import cv2
import numpy as np
from numpy.typing import NDArray

from rhot.arrays import FloatArray, IntArray
from rhot_calibration.cameras.board.grid import (
    MIN_CORNERS,
    GrayImage,
    aruco_dictionary,
    charuco_board,
    dictionary_names,
    extra_corners,
    find_grid,
    is_blank,
    oriented,
)
from rhot_calibration.cameras.solve.views import Board, BoardView

# How sharp a picture of a board is, from the edges of its squares.

_SAMPLES: Final = 33
_REACH: Final = 0.3  # of a square, to either side of an edge
_MIN_CONTRAST: Final = 10.0


def edge_width_px(gray: NDArray[np.uint8], board: Board, ids: IntArray, corners: FloatArray) -> float:
    """Return the median distance over which the edges between neighbouring corners rise from 10 to 90 %.

    An edge is crossed in the middle between two neighbours, along the line to the centres of the squares beside it.

    Args:
        gray: (height, width).
        board: of the corners.
        ids: (n,) indices into `Board.points`.
        corners: (n, 2) pixels.

    Returns:
        pixels; 0 = no edge could be measured.
    """
    flat = np.full((board.rows * board.columns, 2), np.nan)
    flat[ids] = corners
    grid: FloatArray = flat.reshape(board.rows, board.columns, 2)
    profiles = np.concatenate([_crossings(grid), _crossings(np.swapaxes(grid, 0, 1))])
    profiles = profiles[np.isfinite(profiles).all(axis=(1, 2))]
    if not len(profiles):
        return 0.0
    maps = profiles.astype(np.float32)
    values = cv2.remap(gray, maps[..., 0], maps[..., 1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    levels: FloatArray = np.asarray(values, dtype=np.float64)
    rising = (levels[:, 0] <= levels[:, -1])[:, None]
    levels = np.where(rising, levels, np.fliplr(levels))
    low, high = levels[:, :4].mean(axis=1), levels[:, -4:].mean(axis=1)
    clear = high - low > _MIN_CONTRAST
    if not clear.any():
        return 0.0
    share = (levels[clear] - low[clear, None]) / (high - low)[clear, None]
    step = np.linalg.norm(profiles[clear, -1] - profiles[clear, 0], axis=1) / (_SAMPLES - 1)
    rise = (_crossing(share, 0.9) - _crossing(share, 0.1)) * step
    return float(np.median(rise))


def _crossings(grid: FloatArray) -> FloatArray:
    """Return lines (n, samples, 2) across the edges that run along the rows of a grid, without the outermost rows."""
    middle = 0.5 * (grid[1:-1, 1:] + grid[1:-1, :-1])
    across = 0.25 * (grid[2:, 1:] + grid[2:, :-1] - grid[:-2, 1:] - grid[:-2, :-1])
    offsets = np.linspace(-_REACH, _REACH, _SAMPLES)
    lines: FloatArray = (middle[..., None, :] + offsets[:, None] * across[..., None, :]).reshape(-1, _SAMPLES, 2)
    return lines


def _crossing(share: FloatArray, level: float) -> FloatArray:
    """Return the (fractional) sample at which each row of `share` (n, samples) first exceeds a level."""
    after = np.maximum(np.argmax(share > level, axis=1), 1)
    row = np.arange(len(share))
    before_value, after_value = share[row, after - 1], share[row, after]
    fraction: FloatArray = after - 1 + (level - before_value) / np.maximum(after_value - before_value, 1e-9)
    return fraction


MIN_CHARUCO_CORNERS: Final = 6
MIN_MARKERS: Final = 3
_LAYOUT_LIMIT: Final = 0.25  # RMS distance of the markers from where the board has them, in squares
_SIZED_MARKERS: Final = 5
"""Markers whose middles give a homography with something to spare."""
_NEAR_COUNTS: Final = 2


def detect_board(gray: GrayImage, board: Board) -> BoardView | None:
    """Return where the board's inner corners are in a picture, or None when the picture does not show that board.

    A chessboard is found as a whole or not at all, and not when more squares follow outside (the real board is larger
    than the stated one: `wrong_count_hint`). A ChArUco board may be partly hidden: six corners that are not on one
    line will do.

    Args:
        gray: (height, width), uint8.
        board: what to look for.
    """
    found = _charuco(gray, board) if board.is_charuco else _chessboard(gray, board)
    if found is None:
        return None
    ids, corners = found
    return BoardView(ids, corners, edge_width_px(gray, board, ids, corners))


def looks_mirrored(gray: GrayImage, board: Board) -> bool:
    """Tell whether the picture shows the board mirrored.

    Only markers can tell: a plain chessboard and its mirror image are the same (the calibration itself notices).
    """
    if not board.is_charuco or detect_board(gray, board) is not None:
        return False
    return detect_board(np.ascontiguousarray(gray[:, ::-1]), board) is not None


def wrong_count_hint(gray: GrayImage, board: Board) -> tuple[int, int] | None:
    """Return the columns and rows of inner corners that the picture shows, when these are not the stated ones.

    None = the stated board is there, or no board of another count is. Columns and rows come in the order of size of
    the stated board. Takes about a second where no guess fits.
    """
    found = _charuco_count(gray, board) if board.is_charuco else _chessboard_count(gray, board)
    if found is None or sorted(found) == sorted((board.columns, board.rows)):
        return None
    if board.is_charuco:
        return found
    return (max(found), min(found)) if board.columns >= board.rows else (min(found), max(found))


def marker_share(gray: GrayImage, board: Board) -> float | None:
    """Return the side of the markers that a picture shows, as a share of the squares' side; None with too few of them.

    A homography from the markers' middles alone, which lie in the middle of their squares whatever their size, maps
    their corners to the board.
    """
    # Without refinement, sides come out one pixel too short.
    parameters = cv2.aruco.DetectorParameters()
    parameters.cornerRefinementMethod = cv2.aruco.CORNER_REFINE_SUBPIX
    markers = _markers_of(gray, aruco_dictionary(board), parameters)
    description, _ = _fitting_layout(markers, board)
    places = _marker_places(description)
    shared = sorted(markers.keys() & places.keys())
    if len(shared) < _SIZED_MARKERS:
        return None
    pixels = np.array([markers[number] for number in shared])
    middles = np.array([places[number].mean(axis=0) for number in shared])
    H, _ = cv2.findHomography(pixels.mean(axis=1), middles)
    sides = cv2.perspectiveTransform(pixels.reshape(1, -1, 2), H).reshape(-1, 4, 2)
    return float(np.median(np.linalg.norm(sides - np.roll(sides, 1, axis=1), axis=2)))


def seen_dictionary(gray: GrayImage) -> tuple[str, int] | None:
    """Return the dictionary whose markers a picture shows, the smallest that has them all, and how many; None = none.

    OpenCV's dictionaries are tried, the small ones first. A larger one of a kind, such as 4X4, begins with the markers
    of the smaller ones: once it confirms what a smaller one shows, other kinds are not tried, which takes a second.
    """
    best: tuple[str, int] | None = None
    kind = "DICT_"
    for name in sorted(dictionary_names(), key=_dictionary_size):
        if not name.startswith(kind):
            continue
        seen = len(_markers_of(gray, cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, name))))
        own_kind = name.rpartition("_")[0] + "_"
        if seen >= MIN_MARKERS and (best is None or seen > best[1]):
            best = name, seen
        elif best is not None and seen == best[1] and best[0].startswith(own_kind):
            kind = own_kind
    return best


def _dictionary_size(name: str) -> int:
    return len(cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, name)).bytesList)


def _chessboard(gray: GrayImage, board: Board) -> tuple[IntArray, FloatArray] | None:
    grid = find_grid(gray, board.columns, board.rows)
    if grid is None or extra_corners(gray, grid) != (0, 0):
        return None
    return np.arange(board.columns * board.rows, dtype=np.int64), oriented(gray, grid).reshape(-1, 2)


def _chessboard_count(gray: GrayImage, board: Board) -> tuple[int, int] | None:
    if is_blank(gray):
        return None
    tried: set[tuple[int, int]] = set()
    for guess in _likely_counts(gray, board):
        count = guess
        # A part of a larger board leads on to the whole.
        while min(count) >= MIN_CORNERS and tuple(sorted(count)) not in tried:
            tried.add((min(count), max(count)))
            grid = find_grid(gray, *count)
            if grid is None:
                break
            more = extra_corners(gray, grid)
            if more == (0, 0):
                return count
            count = (count[0] + more[0], count[1] + more[1])
    return None


def _likely_counts(gray: GrayImage, board: Board) -> Iterator[tuple[int, int]]:
    """Yield counts to try: what OpenCV grows from a small patch, then the stated one and the nearest others."""
    stated = (board.columns, board.rows)
    any_patch = False
    for patch in ((6, 4), (4, 4), (3, 3)):
        found, _, meta = cv2.findChessboardCornersSBWithMeta(
            gray, patch, flags=cv2.CALIB_CB_LARGER | cv2.CALIB_CB_EXHAUSTIVE
        )
        if found:
            any_patch = True
            yield meta.shape[1], meta.shape[0]
    if not any_patch:
        return
    steps = range(-_NEAR_COUNTS, _NEAR_COUNTS + 1)
    near = [(abs(i) + abs(j), stated[0] + i, stated[1] + j) for i in steps for j in steps]
    yield from ((columns, rows) for far, columns, rows in sorted(near) if far <= _NEAR_COUNTS)


def _charuco(gray: GrayImage, board: Board) -> tuple[IntArray, FloatArray] | None:
    description, misfit = _fitting_layout(_markers(gray, board), board)
    if misfit > _LAYOUT_LIMIT:
        return None
    corners, ids, _, _ = cv2.aruco.CharucoDetector(description).detectBoard(gray)
    numbers = np.asarray(() if ids is None else ids, dtype=np.int64).reshape(-1)
    if len(numbers) < MIN_CHARUCO_CORNERS:
        return None
    order = np.argsort(numbers)
    places = board.points[numbers, :2]
    spread = np.linalg.svd(places - places.mean(axis=0), compute_uv=False)
    if spread[1] < 0.5 * board.square_m:
        return None
    return numbers[order], np.asarray(corners, dtype=np.float64).reshape(-1, 2)[order]


def _charuco_count(gray: GrayImage, board: Board) -> tuple[int, int] | None:
    """Return the count whose marker numbering fits; rows as far as markers are seen, the stated ones where these do."""
    markers = _markers(gray, board)
    if len(markers) < MIN_MARKERS:
        return None
    available = len(aruco_dictionary(board).bytesList)
    best, least = None, _LAYOUT_LIMIT
    max_charuco_columns = 24
    for columns in range(MIN_CORNERS, max_charuco_columns + 1):
        squares_down = -(-2 * (max(markers) + 1) // (columns + 1))
        rows = max(squares_down - 1, MIN_CORNERS)
        if columns == board.columns:
            rows = max(rows, board.rows)
        if (columns + 1) * (rows + 1) // 2 > available:
            continue
        _, misfit = _fitting_layout(markers, replace(board, columns=columns, rows=rows))
        if misfit < least:
            best, least = (columns, rows), misfit
    return best


def _markers(gray: GrayImage, board: Board) -> dict[int, FloatArray]:
    """Return the corners (4, 2) of each marker of the dictionary that is seen, by its number."""
    return _markers_of(gray, aruco_dictionary(board))


def _markers_of(
    gray: GrayImage, dictionary: cv2.aruco.Dictionary, parameters: cv2.aruco.DetectorParameters | None = None
) -> dict[int, FloatArray]:
    if is_blank(gray):
        return {}
    detector = cv2.aruco.ArucoDetector(dictionary, parameters or cv2.aruco.DetectorParameters())
    corners, ids, _ = detector.detectMarkers(gray)
    numbers = [int(number) for number in np.asarray(() if ids is None else ids).reshape(-1)]
    return {
        number: np.asarray(quad, dtype=np.float64).reshape(4, 2) for number, quad in zip(numbers, corners, strict=True)
    }


def _fitting_layout(markers: dict[int, FloatArray], board: Board) -> tuple[cv2.aruco.CharucoBoard, float]:
    """Return the board as OpenCV describes it and how far the markers are from their places on it, RMS, in squares.

    Of the two ways in which OpenCV has put markers on boards with an even number of rows of squares (until 4.6 the
    first square was white), the one that fits better. Infinite = too few markers to tell.
    """
    description = charuco_board(board)
    misfit = _misfit(markers, description)
    description.setLegacyPattern(True)
    legacy = _misfit(markers, description)
    if misfit <= legacy:
        description.setLegacyPattern(False)
    return description, min(misfit, legacy)


def _marker_places(description: cv2.aruco.CharucoBoard) -> dict[int, FloatArray]:
    """Return the corners (4, 2) of each marker of a board, in squares."""
    numbers = [int(number) for number in np.asarray(description.getIds()).reshape(-1)]
    quads = np.asarray(description.getObjPoints(), dtype=np.float64).reshape(-1, 4, 3)[:, :, :2]
    return dict(zip(numbers, quads / description.getSquareLength(), strict=True))


def _misfit(markers: dict[int, FloatArray], description: cv2.aruco.CharucoBoard) -> float:
    places = _marker_places(description)
    shared = sorted(markers.keys() & places.keys())
    if len(shared) < MIN_MARKERS:
        return float("inf")
    pixels = np.concatenate([markers[number] for number in shared])
    wanted = np.concatenate([places[number] for number in shared])
    H, _ = cv2.findHomography(pixels, wanted)
    fitted = cv2.perspectiveTransform(pixels[None], H)[0]
    return float(np.sqrt(((fitted - wanted) ** 2).sum(axis=1).mean()))
