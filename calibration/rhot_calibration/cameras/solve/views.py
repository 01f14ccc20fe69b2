"""What the cameras saw of a calibration board, as data."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from rhot.arrays import FloatArray, IntArray


@dataclass(frozen=True, slots=True)
class Board:
    """A flat calibration board.

    The board frame has its origin in the first inner corner, x along a row of corners, y along a column; as seen by a
    camera in front of the printed face x goes right and y down, so z points away from the viewer, into the board.

    Attributes:
        columns, rows: inner corners along x and along y.
        square_m: side of a square, metres.
        marker_m: side of the ArUco markers of a ChArUco board, metres; None = a plain chessboard.
        dictionary: OpenCV's name of the ArUco dictionary, such as `DICT_5X5_100`, of a ChArUco board.
    """

    columns: int
    rows: int
    square_m: float
    marker_m: float | None = None
    dictionary: str = "DICT_5X5_100"

    @property
    def is_charuco(self) -> bool:
        """Whether the corners carry identities."""
        return self.marker_m is not None

    @property
    def points(self) -> FloatArray:
        """Inner corners (columns · rows, 3), metres, board frame, row by row; z = 0."""
        x, y = np.meshgrid(np.arange(self.columns), np.arange(self.rows))
        return self.square_m * np.column_stack([x.ravel(), y.ravel(), np.zeros(x.size)]).astype(np.float64)

    def __str__(self) -> str:
        """Return how people name it."""
        kind = "ChArUco board" if self.is_charuco else "chessboard"
        return f"{kind} of {self.columns}x{self.rows} inner corners, {1e3 * self.square_m:g} mm squares"


@dataclass(frozen=True, slots=True)
class BoardView:
    """The board in one picture.

    Attributes:
        ids: (n,) indices into `Board.points`, ascending.
        corners: (n, 2) pixels, raw image, sub-pixel.
        sharpness: width of the edges at the corners, pixels, smaller is sharper; 0 = not measured.
    """

    ids: IntArray
    corners: FloatArray
    sharpness: float = 0.0


@dataclass(frozen=True, slots=True)
class ViewSet:
    """All pictures of one calibration.

    Pictures of the same number were taken together: the board stood at one place.

    Attributes:
        board: what was shown.
        sizes: camera name to (width, height), pixels; in the order of `rig.toml`, the first is the reference.
        views: (camera, picture number) to what was found there.
        labels: (camera, picture number) to a name for people (`left/000007.jpg`), also of pictures without a board.
    """

    board: Board
    sizes: Mapping[str, tuple[int, int]]
    views: Mapping[tuple[str, int], BoardView]
    labels: Mapping[tuple[str, int], str]

    @property
    def empty(self) -> tuple[str, ...]:
        """Names of the pictures in which no board was found."""
        return tuple(label for key, label in self.labels.items() if key not in self.views)
