"""Pictures of a board in the true cameras of a simulated rig, as a recording to calibrate from."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from rhot.rig import Rig
from rhot.sim.board import HOLD_S, MOVE_S, BoardMotion, ChessBoard
from rhot.sim.folder import true_cameras
from rhot.sim.renderer import Renderer
from rhot.sim.world import World

FloatArray = NDArray[np.float64]


def write_board_recording(rig: Rig, folder: Path, places: int, seed: int) -> FloatArray:
    """Write `<folder>/<camera>/NNNNNN.png` of a board held still at several places.

    Every camera has a picture of every place, whether it sees the board there or not.

    Args:
        rig: a simulated rig; its [sim] gives the board's size, noise and light.
        folder: of the recording; made when it is not there.
        places: how many.
        seed: of the places.

    Returns:
        T_rig_board (places, 4, 4), metres: where the board was; its frame is that of `ChessBoard`.
    """
    sim = rig.config.sim
    board = ChessBoard(sim.board_columns, sim.board_rows, sim.board_square_m)
    cameras = true_cameras(rig)
    motion = BoardMotion(seed, tuple(cameras.values()), board)
    world = World(seed, {}, {}, motion=motion, board=board)
    for number, (name, camera) in enumerate(cameras.items()):
        renderer = Renderer(camera, world, sim, rig.config.cameras[name], number)
        (folder / name).mkdir(parents=True, exist_ok=True)
        for place in range(places):
            picture = renderer.render(place * (HOLD_S + MOVE_S) + 0.5 * HOLD_S)
            cv2.imwrite(str(folder / name / f"{place:06d}.png"), picture)
    return np.array([motion.place(place) for place in range(places)]).reshape(-1, 4, 4)
