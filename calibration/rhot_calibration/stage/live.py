"""Looking for a board on the desk through the running capture services."""

from __future__ import annotations

import asyncio
import time
from collections.abc import Sequence
from typing import Final

import cv2
import numpy as np

from rhot.bus import Bus
from rhot.errors import BusError
from rhot.recording.picture_file import decode_picture
from rhot_calibration.cameras.board.detect import detect_board
from rhot_calibration.cameras.live.preview import preview_of
from rhot_calibration.cameras.solve.views import Board, BoardView, ViewSet

LOOKS: Final = 3
"""Pictures a camera: the board lies still, and their mean has less noise."""
_ANSWER_S: Final = 2.0
_ALL_THERE_S: Final = 2.0


async def look_at_desk(bus: Bus, cameras: Sequence[str], board: Board) -> ViewSet:
    """Return where the board is in a few pictures of each camera; those of one round have one number.

    Raises:
        BusError: no camera answers.
    """
    silent: dict[str, str] = {}
    answering = await _answering(bus, cameras, silent)
    if not answering:
        why = "; ".join(f"{name}: {text}" for name, text in silent.items())
        raise BusError(f"no camera gives a picture ({why}). Start `rhot up`, and `rhot capture` on the Pis")
    views: dict[tuple[str, int], BoardView] = {}
    labels: dict[tuple[str, int], str] = {}
    sizes: dict[str, tuple[int, int]] = {}
    for number in range(LOOKS):
        pictures = await asyncio.gather(*(_picture(bus, name, silent) for name in answering))
        for name, payload in zip(answering, pictures, strict=True):
            if not payload:
                continue
            size, view = await asyncio.to_thread(_examined, payload, board)
            sizes[name], labels[name, number] = size, f"{name}, picture {number + 1}"
            if view is not None:
                views[name, number] = view
    return ViewSet(board, sizes, views, labels)


async def _answering(bus: Bus, cameras: Sequence[str], silent: dict[str, str]) -> list[str]:
    """Return the cameras that give pictures; a session that has just been opened learns of them by and by."""
    deadline_s = time.monotonic() + _ALL_THERE_S
    while True:
        pictures = await asyncio.gather(*(_picture(bus, name, silent) for name in cameras))
        there = [name for name, payload in zip(cameras, pictures, strict=True) if payload]
        if len(there) == len(cameras) or time.monotonic() > deadline_s:
            return there
        again_s = 0.1
        await asyncio.sleep(again_s)


async def _picture(bus: Bus, name: str, silent: dict[str, str]) -> bytes:
    payload, reason = await preview_of(bus, name, "png", _ANSWER_S)
    if payload is None:
        silent[name] = reason
    return payload or b""


def _examined(payload: bytes, board: Board) -> tuple[tuple[int, int], BoardView | None]:
    picture = decode_picture(payload, cv2.IMREAD_GRAYSCALE)
    if picture is None:
        return (0, 0), None
    gray = np.asarray(picture, np.uint8)
    return (gray.shape[1], gray.shape[0]), detect_board(gray, board)
