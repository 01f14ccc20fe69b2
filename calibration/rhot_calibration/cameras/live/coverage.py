"""What a set of board views still lacks before the cameras can be calibrated from it.

Nothing needs to be known of the cameras: tilts come from each view's homography with a nominal focal length, distances
from the apparent size of the squares.

The limits come from calibrations of simulated views (640x480, true focal length 530 px, corners with 0.1 px of noise,
`cv2.calibrateCamera` with five coefficients, 12 runs each; RMS error of the focal length, median over the runs of the
largest error near the rim of the picture):

    15 views at 45 to 90 cm, tilts up to     10°: 1.6 %    20°: 0.53 %    30°: 0.34 %    40°: 0.27 %
    the same, tilted to one side only        35°: 0.66 %
    tilts up to 35°, number of views          6: 0.62 %     10: 0.35 %     20: 0.17 %     30: 0.13 %
    board's middle within that share of the picture   20 %: 17 px off at the rim    50 %: 2.2 px    80 %: 2.0 px
    all at one distance, where the corners take   0.18 of the width: 0.43 %    0.28: 0.15 %    0.37: 0.10 %

So nearness counts; a range of distances alone (45 to 67 cm: 0.19 %) brings nothing, and is shown but not asked for.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations
from typing import Final

import cv2
import numpy as np
from numpy.typing import NDArray

from rhot.arrays import FloatArray
from rhot_calibration.cameras.solve.views import Board, BoardView, ViewSet

WANTED_VIEWS: Final = 15
"""Of each camera; with well spread tilts the focal length is then right to about 0.3 %."""
WANTED_TILT_DEG: Final = 20.0
WANTED_TILTED: Final = 2
"""So many views tilted by `WANTED_TILT_DEG` to each of the four sides: to one side alone doubles the error."""
WANTED_AREA: Final = 0.6
"""Share of the picture that boards have covered; below half, the lens is a guess outside of it."""
WANTED_FILL: Final = 0.30
"""Share of the picture's width or height between the outer corners of the nearest board; the whole board then takes
about 0.4 of it."""
WANTED_SHARED: Final = 4
"""Pictures that two cameras must share to be tied to each other directly."""
WANTED_CORNERS: Final = 6
"""A view with fewer corners ties nothing."""
SIMILAR_SHARE: Final = 0.03
"""Two views whose corners lie nearer than this share of the picture's width (RMS) are one view."""

GRID_ROWS: Final = 9
GRID_COLUMNS: Final = 12
_NOMINAL_FOCAL: Final = 0.85
"""Focal length over width: a field of view of 61°, between a Pi camera's 62° and a webcam's 60°."""

_REGIONS: Final = {
    "upper left corner": (slice(0, 3), slice(0, 3)),
    "upper right corner": (slice(0, 3), slice(9, 12)),
    "lower left corner": (slice(6, 9), slice(0, 3)),
    "lower right corner": (slice(6, 9), slice(9, 12)),
    "left edge": (slice(3, 6), slice(0, 3)),
    "right edge": (slice(3, 6), slice(9, 12)),
    "upper edge": (slice(0, 3), slice(4, 8)),
    "lower edge": (slice(6, 9), slice(4, 8)),
    "middle": (slice(3, 6), slice(4, 8)),
}
_MIN_REGION: Final = 0.4
"""Share of a region's cells that count as having been there; the outermost are out of reach of inner corners."""
_SIDES: Final = (
    ("left", "tilt its left edge away from the camera (turn it about the vertical axis)"),
    ("right", "tilt its right edge away from the camera (turn it about the vertical axis)"),
    ("top", "tilt its upper edge away from the camera (turn it about the horizontal axis)"),
    ("bottom", "tilt its lower edge away from the camera (turn it about the horizontal axis)"),
)


@dataclass(frozen=True, slots=True)
class CameraCoverage:
    """What one camera has seen of the board.

    Attributes:
        views: pictures that show the board.
        area: (GRID_ROWS, GRID_COLUMNS) bool, parts of the picture that a board has covered, as in the picture.
        fills: (views,) share of the picture's width or height that the board takes, whichever is larger; grows with
            nearness.
        tilts_deg: (views, 2) about the vertical axis (positive: the board's right edge is further away) and about the
            horizontal one (positive: its lower edge is).
        missing: what is still to be done, sentences for people; empty = enough.
    """

    views: int
    area: NDArray[np.bool_]
    fills: FloatArray
    tilts_deg: FloatArray
    missing: tuple[str, ...]

    @property
    def area_share(self) -> float:
        """Share of the picture that boards have covered."""
        return float(self.area.mean())

    @property
    def tilted(self) -> dict[str, int]:
        """How many views are tilted enough, by the edge that is further away: left, right, top, bottom."""
        about_vertical, about_horizontal = self.tilts_deg.reshape(-1, 2).T
        return {
            "left": int((about_vertical <= -WANTED_TILT_DEG).sum()),
            "right": int((about_vertical >= WANTED_TILT_DEG).sum()),
            "top": int((about_horizontal <= -WANTED_TILT_DEG).sum()),
            "bottom": int((about_horizontal >= WANTED_TILT_DEG).sum()),
        }

    @property
    def share(self) -> float:
        """How much of all that is asked for is there, 0 to 1."""
        parts = [
            min(1.0, self.views / WANTED_VIEWS),
            min(1.0, self.area_share / WANTED_AREA),
            min(1.0, float(self.fills.max(initial=0.0)) / WANTED_FILL),
            sum(min(1.0, count / WANTED_TILTED) for count in self.tilted.values()) / 4.0,
        ]
        return sum(parts) / len(parts)


def camera_coverage(views: ViewSet) -> dict[str, CameraCoverage]:
    """Return what each camera has seen of the board, and what it has not."""
    return {
        name: _coverage(views.board, size, [view for (camera, _), view in views.views.items() if camera == name])
        for name, size in views.sizes.items()
    }


def links(views: ViewSet) -> dict[tuple[str, str], int]:
    """Return the number of pictures that each pair of cameras shares, pairs in the cameras' order."""
    seen = {
        name: {number for (camera, number), view in views.views.items() if camera == name and _ties(view)}
        for name in views.sizes
    }
    return {(a, b): len(seen[a] & seen[b]) for a, b in combinations(views.sizes, 2)}


def unlinked(views: ViewSet) -> list[tuple[str, ...]]:
    """Return the groups of cameras that no chain of shared pictures ties together; empty when all are tied."""
    groups = [{name} for name in views.sizes]
    for (a, b), shared in links(views).items():
        if shared >= WANTED_SHARED:
            first, second = (next(group for group in groups if name in group) for name in (a, b))
            if first is not second:
                first |= second
                groups.remove(second)
    if len(groups) < 2:
        return []
    return [tuple(name for name in views.sizes if name in group) for group in groups]


def similar(first: BoardView, second: BoardView, width: int) -> bool:
    """Tell whether two views of one camera, whose pictures are `width` pixels wide, say the same.

    What counts is the RMS distance of corresponding corners: whether the board is elsewhere, nearer, further, or
    tilted differently.
    """
    _, ours, theirs = np.intersect1d(first.ids, second.ids, assume_unique=True, return_indices=True)
    if ours.size == 0:
        return False
    offsets = first.corners[ours] - second.corners[theirs]
    return bool(np.sqrt((offsets**2).sum(axis=1).mean()) < SIMILAR_SHARE * width)


def tilt_deg(board: Board, view: BoardView, size: tuple[int, int]) -> FloatArray:
    """Return the board's tilt (2,) against the picture's plane: about the vertical and the horizontal axis, degrees.

    A board parallel to that plane, wherever it is, says nothing of the focal length. From the homography
    H ~ K [r1 r2 t] with a nominal K; r1 × r2 is the board's normal (Zhang 2000, section 3.1). Positive: the right edge,
    the lower edge is further away.
    """
    width, height = size
    H = np.asarray(cv2.findHomography(board.points[view.ids, :2], view.corners)[0], dtype=np.float64)
    if H.shape != (3, 3):
        return np.zeros(2)
    K = np.array([[1.0, 0.0, (width - 1) / 2.0], [0.0, 1.0, (height - 1) / 2.0], [0.0, 0.0, 1.0]])
    K[[0, 1], [0, 1]] = _NOMINAL_FOCAL * width
    columns = np.linalg.solve(K, H)
    columns /= np.linalg.norm(columns[:, 0]) * np.sign(columns[2, 2])
    normal = np.cross(columns[:, 0], columns[:, 1])
    x, y, z = normal / np.linalg.norm(normal)
    # In the board's plane z grows with x by −n_x/n_z.
    return np.degrees([np.arctan2(-x, z), np.arctan2(-y, z)])


def _ties(view: BoardView) -> bool:
    return len(view.ids) >= WANTED_CORNERS


def _coverage(board: Board, size: tuple[int, int], seen: Sequence[BoardView]) -> CameraCoverage:
    usable = [view for view in seen if _ties(view)]
    area = np.zeros((GRID_ROWS, GRID_COLUMNS), dtype=bool)
    for view in usable:
        area |= _covered(view, size)
    fills = np.array([float((np.ptp(view.corners, axis=0) / size).max()) for view in usable])
    tilts = np.array([tilt_deg(board, view, size) for view in usable]).reshape(-1, 2)
    so_far = CameraCoverage(len(usable), area, fills, tilts, ())
    for array in (area, fills, tilts):
        array.setflags(write=False)
    return CameraCoverage(len(usable), area, fills, tilts, _missing(so_far))


def _covered(view: BoardView, size: tuple[int, int]) -> NDArray[np.bool_]:
    """Return the cells (GRID_ROWS, GRID_COLUMNS) of the picture that hold a corner or whose middle lies among them."""
    hull = cv2.convexHull(view.corners.astype(np.float32), clockwise=True).reshape(-1, 2).astype(np.float64)
    edges = np.roll(hull, -1, axis=0) - hull
    u, v = (
        (np.arange(count) + 0.5) * length / count - 0.5
        for count, length in ((GRID_COLUMNS, size[0]), (GRID_ROWS, size[1]))
    )
    right, down = u[None, :, None] - hull[:, 0], v[:, None, None] - hull[:, 1]
    sides = edges[:, 0] * down - edges[:, 1] * right
    covered: NDArray[np.bool_] = np.abs(np.sign(sides).sum(axis=-1)) >= len(hull)
    columns, rows = np.floor((view.corners + 0.5) / size * (GRID_COLUMNS, GRID_ROWS)).astype(int).T
    covered[rows.clip(0, GRID_ROWS - 1), columns.clip(0, GRID_COLUMNS - 1)] = True
    return covered


def _missing(seen: CameraCoverage) -> tuple[str, ...]:
    if seen.views == 0:
        return ("show it the board",)
    said = [
        f"bring the board to the {name}" if name != "middle" else "hold the board in the middle of the picture"
        for name, region in _REGIONS.items()
        if seen.area[region].mean() < _MIN_REGION
    ]
    if seen.fills.max() < WANTED_FILL:
        said.append("hold it nearer (until the board fills nearly half the picture)")
    tilted = seen.tilted
    said += [sentence for side, sentence in _SIDES if tilted[side] < WANTED_TILTED]
    if not said and seen.area_share < WANTED_AREA:
        said.append(f"cover more of the picture ({100 * seen.area_share:.0f} of {100 * WANTED_AREA:.0f} %)")
    if seen.views < WANTED_VIEWS:
        said.append(f"{WANTED_VIEWS - seen.views} more views")
    return tuple(said)
