"""Drawn pictures of calibration boards whose corners are known."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from rhot.arrays import FloatArray
from rhot_calibration.cameras.board.grid import charuco_board
from rhot_calibration.cameras.solve.views import Board

GrayImage = NDArray[np.uint8]

PX_PER_SQUARE = 80
_FINER = 4


def board_picture(
    board: Board,
    *,
    size: tuple[int, int] = (640, 480),
    tilt_deg: tuple[float, float, float] = (15.0, -20.0, 10.0),
    distance_m: float = 0.5,
    noise: float = 2.0,
    seed: int = 0,
) -> tuple[GrayImage, FloatArray]:
    """Return a picture (height, width) of a board before a dark desk and its true corners (n, 2), pixels."""
    width, height = size
    focal = 0.8 * width
    K = np.array([[focal, 0.0, 0.5 * (width - 1)], [0.0, focal, 0.5 * (height - 1)], [0.0, 0.0, 1.0]])
    R = np.eye(3)
    for axis, angle in enumerate(np.radians(tilt_deg)):
        R = cv2.Rodrigues(np.eye(3)[axis] * angle)[0] @ R
    center = board.points.mean(axis=0)
    t = np.array([0.0, 0.0, distance_m]) - R @ center
    H = K @ np.column_stack([R[:, 0], R[:, 1], t])
    corners = cv2.perspectiveTransform(board.points[None, :, :2], H)[0]
    # Texture pixels to board metres; pixel centres are on integers, the first corner two squares from the rim.
    scale = board.square_m / PX_PER_SQUARE
    texture_to_board = np.array([[scale, 0.0, scale * 0.5], [0.0, scale, scale * 0.5], [0.0, 0.0, 1.0]])
    texture_to_board[:2, 2] -= 2.0 * board.square_m
    fine = np.array([[_FINER, 0.0, 0.5 * (_FINER - 1)], [0.0, _FINER, 0.5 * (_FINER - 1)], [0.0, 0.0, 1.0]])
    large = cv2.warpPerspective(
        board_texture(board), fine @ H @ texture_to_board, (width * _FINER, height * _FINER), borderValue=40.0
    )
    picture = cv2.GaussianBlur(cv2.resize(large, size, interpolation=cv2.INTER_AREA), (0, 0), 0.7).astype(np.float64)
    picture += np.random.default_rng(seed).normal(0.0, noise, picture.shape)
    return np.clip(picture, 0, 255).astype(np.uint8), corners


def board_texture(board: Board) -> GrayImage:
    """Return the printed board with a rim of one square, `PX_PER_SQUARE` pixels a square."""
    squares = np.add.outer(np.arange(board.rows + 1), np.arange(board.columns + 1)) % 2 * 220 + 20
    face = np.kron(squares, np.ones((PX_PER_SQUARE, PX_PER_SQUARE))).astype(np.uint8)
    if board.is_charuco:
        image = charuco_board(board).generateImage((face.shape[1], face.shape[0]), marginSize=0)
        face = np.clip(np.asarray(image), 20, 240).astype(np.uint8)
    return np.pad(face, PX_PER_SQUARE, constant_values=240)
