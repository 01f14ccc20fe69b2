"""From a desk or a registration to the stage: right-handed, metres, y up, −z forward, origin on the floor.

With `up` the desk's normal, `f` the direction in which the person looks who sits at the desk, and p₀ the point of the
floor under the first camera:

    T_rig_stage = [ f × up | up | −f | p₀ ],   p₀ = c − (up · c − offset + h) · up,

where c is the first camera's centre, `up · p = offset` the desk's plane and h the desk's height. f is a direction of
the first camera's picture, laid into the plane: with the cameras looking down and their cables away from the person
(docs/build.md), hands come in at the picture's upper edge and f points *down* in it.
"""

from __future__ import annotations

import asyncio
import time
from collections.abc import Sequence
from typing import Final, Literal, get_args

import cv2
import numpy as np

from rhot.arrays import FloatArray
from rhot.bus import Bus
from rhot.errors import BusError, CalibrationError
from rhot.geometry.camera import CameraModel
from rhot.geometry.rotations import rigid
from rhot.quality import figure
from rhot.recording.picture_file import decode_picture
from rhot.rig import RegistrationFile, RigidTransform, StageFile
from rhot.rig.calibration import today
from rhot_calibration.cameras.board.detect import detect_board
from rhot_calibration.cameras.live.display import preview_of
from rhot_calibration.cameras.solve.views import Board, BoardView, ViewSet
from rhot_calibration.stage.desk import DeskFit

# Looking for a board on the desk through the running capture services.

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


Forward = Literal["down", "up", "left", "right"]
FORWARDS: Final[tuple[Forward, ...]] = get_args(Forward)
DESK_SOURCE: Final = "desk board"
REGISTRATION_SOURCE: Final = "registration"

_IN_PICTURE: Final = {
    "down": (0.0, 1.0, 0.0),
    "up": (0.0, -1.0, 0.0),
    "right": (1.0, 0.0, 0.0),
    "left": (-1.0, 0.0, 0.0),
}
"""Camera axes, OpenCV's."""


def stage_from_desk(fit: DeskFit, camera: CameraModel, desk_height_m: float, forward: Forward) -> FloatArray:
    """Return T_rig_stage (4, 4), metres.

    Args:
        fit: the desk's plane.
        camera: the first camera.
        desk_height_m: of the desk's top over the floor.
        forward: where in its picture the person looks who sits at the desk.

    Raises:
        CalibrationError: that direction is vertical in the world.
    """
    pointed = camera.R_camera_rig.T @ np.array(_IN_PICTURE[forward])
    f = pointed - (pointed @ fit.up) * fit.up
    length = float(np.linalg.norm(f))
    # Length of a picture's direction once it is laid into the desk: below it, 12°, that direction is nearly
    # vertical.
    if length < 0.2:
        raise CalibrationError(
            f"'{forward}' in the first camera's picture points along the vertical, so it cannot be the direction in "
            f"which the person looks; choose another --forward: {', '.join(FORWARDS)}"
        )
    f /= length
    origin = camera.center - (fit.up @ camera.center - fit.offset_m + desk_height_m) * fit.up
    return rigid(np.column_stack([np.cross(f, fit.up), fit.up, -f]), origin)


def desk_file(
    fit: DeskFit, camera: CameraModel, desk_height_m: float, thickness_m: float, forward: Forward
) -> StageFile:
    """Return `stage.json` of a desk.

    Args:
        fit: the plane of the board's printed face.
        camera: the first camera.
        desk_height_m: of the desk's top over the floor.
        thickness_m: of the board.
        forward: see `stage_from_desk`.
    """
    return StageFile(
        date=today(),
        T_rig_stage=RigidTransform.from_matrix(stage_from_desk(fit, camera, desk_height_m + thickness_m, forward)),
        source=DESK_SOURCE,
        residual_m=fit.residual_m,
        desk_height_m=desk_height_m,
        quality={
            "boards": fit.boards,
            "left_out": len(fit.left_out),
            **({} if fit.residual_m is None else {"residual_mm": 1e3 * fit.residual_m}),
            "residual_px": fit.rms_px,
            "up_sd_deg": float(np.degrees(fit.tilt_sd_rad)),
            "height_sd_mm": 1e3 * fit.height_sd_m,
            "forward": forward,
        },
    )


def registration_stage(file: RegistrationFile, source: str) -> StageFile:
    """Return `stage.json` of a tracking system whose space has y up, −z forward and its origin on the floor already.

    Args:
        file: the registration: T_rig_stage = T_rig_tracker.
        source: of the tracking, such as `steamvr`.
    """
    rms_mm = figure(file.quality, "residual_rms_mm")
    return StageFile(
        date=today(),
        T_rig_stage=file.T_rig_tracker,
        source=f"{source} {REGISTRATION_SOURCE}",
        residual_m=None if rms_mm is None else 1e-3 * rms_mm,
        quality={"registered": file.date, **({} if rms_mm is None else {"residual_mm": rms_mm})},
    )
