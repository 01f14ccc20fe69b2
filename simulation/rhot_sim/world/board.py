"""A calibration chessboard in place of a hand: held still at a place, then carried to the next.

Places follow from seed and number. They take the cameras in turn, and of each the nine regions of its picture in an
order of the seed's; distances and tilts vary from place to place. In its camera a place shows the whole board. For
finding the floor it lies on the desk instead.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Final

import numpy as np

from rhot.arrays import FloatArray
from rhot.geometry.camera import CameraModel
from rhot.geometry.rotations import rigid, rotation_from_vector, vector_from_rotation
from rhot_sim.world.motion import MotionSample
from rhot_sim.world.script import seeded

BOARD: Final = "board"
"""Name of the board among the world's objects."""
HOLD_S: Final = 1.5
MOVE_S: Final = 1.0
NEAR_M: Final = 0.40
FAR_M: Final = 1.10
MAX_TILT_DEG: Final = 45.0
MAX_ROLL_DEG: Final = 25.0
LYING_YAW_RAD: Final = 0.2
"""Of the board on the desk: nobody lays it down exactly straight."""
RIM_SQUARES: Final = 1.0
"""White paper around the squares, in squares."""

_STREAM: Final = 30
_REGIONS: Final = 9
_GOLDEN_RAD: Final = np.pi * (3.0 - np.sqrt(5.0))
_FIT_MARGIN_PX: Final = 3.0


@dataclass(frozen=True, slots=True)
class ChessBoard:
    """A chessboard.

    Its frame has the origin in the first inner corner, x along a row, y along a column, z away from who looks at the
    printed face. The square between the first four inner corners is dark.

    Attributes:
        columns, rows: inner corners along x and y.
        square_m: side of a square, metres.
    """

    columns: int = 9
    rows: int = 6
    square_m: float = 0.025

    @property
    def corners(self) -> FloatArray:
        """Inner corners (columns · rows, 3), metres, board frame, row by row."""
        x, y = np.meshgrid(np.arange(self.columns), np.arange(self.rows))
        return self.square_m * np.column_stack([x.ravel(), y.ravel(), np.zeros(x.size)]).astype(np.float64)

    @property
    def outline(self) -> FloatArray:
        """Points (N, 3) along the edge of the printed squares and its white rim, metres, board frame."""
        low, right, bottom = -1.0 - RIM_SQUARES, self.columns + RIM_SQUARES, self.rows + RIM_SQUARES
        share = np.linspace(0.0, 1.0, 9)
        x, y = low + share * (right - low), low + share * (bottom - low)
        edges = [(x, np.full(9, low)), (x, np.full(9, bottom)), (np.full(9, low), y), (np.full(9, right), y)]
        return np.concatenate([self.square_m * np.column_stack([*edge, np.zeros(9)]) for edge in edges])

    @property
    def middle(self) -> FloatArray:
        """The middle of the corners (3,), metres, board frame."""
        return self.square_m * np.array([(self.columns - 1) / 2.0, (self.rows - 1) / 2.0, 0.0])


class BoardMotion:
    """The board's poses as a function of (seed, time); before time 0 it is held at its first place.

    Args:
        seed: chooses the places.
        cameras: the true cameras that are to see it.
        board: its size.
    """

    def __init__(self, seed: int, cameras: Sequence[CameraModel], board: ChessBoard) -> None:
        self._seed = seed
        self._cameras = tuple(cameras)
        self._board = board
        # A table of a pure function: dropping or keeping an entry changes no result.
        self.place = lru_cache(maxsize=64)(self._place)

    def sample(self, t_s: FloatArray) -> MotionSample:
        """Return the board's poses at times (N,), seconds since the world's start, as object `board`."""
        t = np.maximum(np.asarray(t_s, dtype=np.float64), 0.0)
        number = np.floor(t / (HOLD_S + MOVE_S)).astype(np.int64)
        poses = np.empty((len(t), 4, 4))
        for one in np.unique(number):
            mine = number == one
            passed = np.clip((t[mine] - one * (HOLD_S + MOVE_S) - HOLD_S) / MOVE_S, 0.0, 1.0)
            poses[mine] = _between(self.place(int(one)), self.place(int(one) + 1), passed)
        return MotionSample({}, {}, {BOARD: poses})

    def _place(self, number: int) -> FloatArray:
        """Return T_rig_board (4, 4), metres, of a place by its number."""
        camera = self._cameras[number % len(self._cameras)]
        turn = number // len(self._cameras)
        rng = seeded(self._seed, _STREAM, number)
        order = seeded(self._seed, _STREAM, 0, number % len(self._cameras), turn // _REGIONS).permutation(_REGIONS)
        row, column = divmod(int(order[turn % _REGIONS]), 3)
        target = np.array([column, row]) / 2.0 * [camera.width - 1.0, camera.height - 1.0]
        tilt = np.radians(rng.uniform(0.0 if turn % 4 == 0 else 0.5 * MAX_TILT_DEG, MAX_TILT_DEG))
        direction = _GOLDEN_RAD * turn + rng.uniform(-0.4, 0.4)
        roll = np.radians(rng.uniform(-MAX_ROLL_DEG, MAX_ROLL_DEG))
        R = rotation_from_vector(tilt * np.array([np.cos(direction), np.sin(direction), 0.0]))
        R = R @ rotation_from_vector(np.array([0.0, 0.0, roll]))
        distance = NEAR_M * (FAR_M / NEAR_M) ** rng.uniform()
        return self._fitted(camera, R, target, distance)

    def _fitted(
        self, camera: CameraModel, R_camera_board: FloatArray, target: FloatArray, distance: float
    ) -> FloatArray:
        """Return T_rig_board as near to a target (u, v) as shows the whole board, further away where it must be."""
        low, high = np.full(2, _FIT_MARGIN_PX), np.array([camera.width, camera.height]) - 1.0 - _FIT_MARGIN_PX
        pixel = target.astype(np.float64)
        T = np.eye(4)
        fit_rounds = 12
        for _ in range(fit_rounds):
            ray = np.append(camera.undistort(pixel[None])[0], 1.0)
            T_camera_board = np.eye(4)
            T_camera_board[:3, :3] = R_camera_board
            T_camera_board[:3, 3] = distance * ray - R_camera_board @ self._board.middle
            T = camera.T_rig_camera @ T_camera_board
            seen = camera.project(self._board.outline @ T[:3, :3].T + T[:3, 3])
            over = np.maximum(seen.max(axis=0) - high, 0.0) - np.maximum(low - seen.min(axis=0), 0.0)
            if np.abs(over).max() == 0.0:
                break
            if (np.ptp(seen, axis=0) > high - low).any():
                smaller = 1.12
                distance *= smaller
            pixel = np.clip(pixel - over, low, high)
        return T


class LyingBoard:
    """The board flat on the desk, printed face up, before the reference camera; it never moves.

    Args:
        board: its size.
        desk_z_m: distance of the desk from the reference camera.
    """

    def __init__(self, board: ChessBoard, desk_z_m: float) -> None:
        R = rotation_from_vector(np.array([0.0, 0.0, LYING_YAW_RAD]))
        self._pose = rigid(R, np.array([0.0, 0.0, desk_z_m]) - R @ board.middle)

    def sample(self, t_s: FloatArray) -> MotionSample:
        """Return the one pose for each of the times (N,), as object `board`."""
        return MotionSample({}, {}, {BOARD: np.tile(self._pose, (len(t_s), 1, 1))})


def _between(start: FloatArray, end: FloatArray, passed: FloatArray) -> FloatArray:
    """Return poses (N, 4, 4) on the way between two; speed and acceleration are 0 at both ends.

    The way is 10 s³ − 15 s⁴ + 6 s⁵ of the whole at the share s of the time, for place and turn alike.
    """
    way = passed**3 * (10.0 + passed * (6.0 * passed - 15.0))
    axis = vector_from_rotation(start[:3, :3].T @ end[:3, :3])
    poses = np.tile(start, (len(passed), 1, 1))
    for place in np.flatnonzero(way > 0.0):
        poses[place, :3, :3] = start[:3, :3] @ rotation_from_vector(way[place] * axis)
    poses[:, :3, 3] += way[:, None] * (end[:3, 3] - start[:3, 3])
    return poses
