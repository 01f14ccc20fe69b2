"""From a desk or a registration to the stage: right-handed, metres, y up, −z forward, origin on the floor.

With `up` the desk's normal, `f` the direction in which the person looks who sits at the desk, and p₀ the point of the
floor under the first camera:

    T_rig_stage = [ f × up | up | −f | p₀ ],   p₀ = c − (up · c − offset + h) · up,

where c is the first camera's centre, `up · p = offset` the desk's plane and h the desk's height. f is a direction of
the first camera's picture, laid into the plane: with the cameras looking down and their cables away from the person
(docs/build.md), hands come in at the picture's upper edge and f points *down* in it.
"""

from __future__ import annotations

from typing import Final, Literal, get_args

import numpy as np

from rhot.arrays import FloatArray
from rhot.errors import CalibrationError
from rhot.geometry.camera import CameraModel
from rhot.geometry.transforms import rigid
from rhot.rig import RegistrationFile, RigidTransform, StageFile
from rhot.rig.calibration import today
from rhot.rig.quality import figure
from rhot_calibration.stage.desk import DeskFit

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
