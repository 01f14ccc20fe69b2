"""The simulated chessboard in one camera's picture.

Every pixel's ray is met with the board's plane, and the pattern is averaged over the pixel. The average is exact for a
box in the plane whose sides lie along the board's: with the width w_x = |∇x| it has the variance of the pixel's own
footprint, and lying evenly about the pixel it shifts no edge and no corner.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Final

import numpy as np

from rhot.arrays import FloatArray
from rhot.geometry.camera import CameraModel
from rhot_sim.rendering.backdrop import Image
from rhot_sim.rendering.canvas import Window
from rhot_sim.world.board import RIM_SQUARES, ChessBoard

Poses = Callable[[FloatArray], FloatArray]

PAPER: Final = 205.0
INK: Final = 28.0
CARDBOARD: Final = 120.0
"""Grey levels in even light: of paper, of ink, and of the back."""


class BoardPainter:
    """Paints a board into the pictures of one camera.

    Args:
        camera: the true camera.
        board: its size.
    """

    def __init__(self, camera: CameraModel, board: ChessBoard) -> None:
        self._camera = camera
        self._board = board
        columns, rows = np.meshgrid(np.arange(camera.width), np.arange(camera.height))
        rays = camera.undistort(np.column_stack([columns.ravel(), rows.ravel()]).astype(np.float64))
        self._rays = np.ascontiguousarray(rays.reshape(camera.height, camera.width, 2).transpose(2, 0, 1))

    def paint(self, image: Image, poses: Poses, moments_s: FloatArray, readout_s: float, light: float) -> None:
        """Paint the board into an image (height, width, 3) in place: the mean over moments of the exposure.

        Args:
            image: as it is without the board.
            poses: gives T_rig_board (N, 4, 4), metres, at times (N,).
            moments_s: (M,) moments of the first row.
            readout_s: from the first to the last row.
            light: the lamp's brightness.
        """
        ends = poses(np.array([moments_s[0], moments_s[-1] + readout_s]))
        still = bool(np.array_equal(ends[0], ends[1]))
        window = self._window(ends)
        if window is None:
            return
        area = (slice(window.top, window.bottom), slice(window.left, window.right))
        row_share = np.arange(window.top, window.bottom) / (self._camera.height - 1)
        total = np.zeros(image[area].shape[:2])
        covered = np.zeros_like(total)
        drawn = moments_s[:1] if still else moments_s
        for moment in drawn:
            at = poses(moments_s[:1] if still else moment + readout_s * row_share)
            share, gray = self._seen(at, area)
            total += share * gray
            covered += share
        board, desk = light * total / len(drawn), 1.0 - covered / len(drawn)
        mixed = image[area] * desk[..., None] + board[..., None]
        image[area] = np.clip(np.rint(mixed), 0.0, 255.0).astype(np.uint8)

    def travel_px(self, poses: FloatArray) -> float:
        """Return how far the board's edge moves in the picture between two poses (2, 4, 4), pixels."""
        first, second = (self._camera.project(self._board.outline @ T[:3, :3].T + T[:3, 3]) for T in poses)
        return float(np.nan_to_num(np.abs(second - first)).max())

    def _window(self, poses: FloatArray) -> Window | None:
        points = np.concatenate([self._board.outline @ T[:3, :3].T + T[:3, 3] for T in poses])
        pixels = self._camera.project(points)
        width, height = self._camera.width, self._camera.height
        if np.isnan(pixels).all():
            return None
        # Partly behind the camera, the board's edge is nowhere in the picture.
        return Window(0, 0, width, height) if np.isnan(pixels).any() else Window.around(pixels, width, height)

    def _seen(self, T_rig_board: FloatArray, area: tuple[slice, slice]) -> tuple[FloatArray, FloatArray]:
        """Return the share of each pixel that the board covers, and its grey level, for one pose or one a row."""
        R = self._camera.R_camera_rig @ T_rig_board[:, :3, :3]
        t = T_rig_board[:, :3, 3] @ self._camera.R_camera_rig.T + self._camera.t_camera_rig
        # With p = (x, y, 1) on the board, metres, and the ray r: λ r = [R_x R_y t] p.
        M = np.linalg.inv(np.stack([R[:, :, 0], R[:, :, 1], t], axis=-1))[:, :, :, None]
        u, v = self._rays[0][area], self._rays[1][area]
        first, second, depth = (M[:, i, 0] * u + M[:, i, 1] * v + M[:, i, 2] for i in range(3))
        ahead = depth > 0.0
        depth = np.where(ahead, depth, np.inf) * self._board.square_m
        x, y = first / depth, second / depth
        across, down = _width(x), _width(y)
        low, right, bottom = -1.0, float(self._board.columns), float(self._board.rows)
        share = _inside(x, across, low - RIM_SQUARES, right + RIM_SQUARES)
        share *= _inside(y, down, low - RIM_SQUARES, bottom + RIM_SQUARES)
        printed = _inside(x, across, low, right) * _inside(y, down, low, bottom)
        signed = _wave(x, across, low, right) * _wave(y, down, low, bottom)
        gray = PAPER + 0.5 * (printed + signed) * (INK - PAPER)
        # Seen from behind where z points at the camera.
        behind = np.einsum("nc,nc->n", R[:, :, 2], t) < 0.0
        return share * ahead, np.where(behind[:, None], CARDBOARD, gray)


def _width(x: FloatArray) -> FloatArray:
    """Return the length of x's gradient over the picture, at least a little."""
    rows, columns = np.gradient(x)
    width: FloatArray = np.maximum(np.hypot(rows, columns), 1e-6)
    return width


def _inside(x: FloatArray, width: FloatArray, low: float, high: float) -> FloatArray:
    """Return the share of [x − w/2, x + w/2] that lies between low and high."""
    share: FloatArray = (np.clip(x + width / 2.0, low, high) - np.clip(x - width / 2.0, low, high)) / width
    return share


def _wave(x: FloatArray, width: FloatArray, low: float, high: float) -> FloatArray:
    """Return the mean over [x − w/2, x + w/2] of +1 on even squares, −1 on odd ones, 0 outside [low, high]."""
    ends = (np.clip(x + side * width / 2.0, low, high) for side in (1.0, -1.0))
    after, before = (1.0 - np.abs(np.mod(end, 2.0) - 1.0) for end in ends)
    mean: FloatArray = (after - before) / width
    return mean
