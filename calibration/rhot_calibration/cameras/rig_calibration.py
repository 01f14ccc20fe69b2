"""From pictures of a board to the cameras of a rig, with what its folder says of them."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from rhot.errors import CalibrationError
from rhot.rig import Rig
from rhot.rig.folder import nominal_camera
from rhot_calibration.cameras.calibration import Calibrated, calibrate
from rhot_calibration.cameras.pictures import PictureReading
from rhot_calibration.cameras.refusals import Expected
from rhot_calibration.cameras.solve.views import ViewSet


def calibrate_rig(
    rig: Rig, views: ViewSet, baseline_m: float | None, progress: Callable[[str], None] = lambda _: None
) -> Calibrated:
    """Return the calibration of a rig's cameras.

    Args:
        rig: its places and fields of view are roughly known from `rig.toml`.
        views: of the board.
        baseline_m: measured distance of the first two lenses; None = not measured.
        progress: told what is being done.

    Raises:
        CalibrationError: what cannot be right is refused, with the reason and what to do.
    """
    # The lenses start from rig.toml, not from the last calibration: a new camera may be in its place.
    nominal = {name: nominal_camera(camera) for name, camera in rig.config.cameras.items()}
    expected = Expected(
        nominal={name: np.array(camera.position_m) for name, camera in rig.config.cameras.items()},
        previous={name: np.array(camera.T_rig_camera)[:3, 3] for name, camera in rig.cameras.items()}
        if rig.calibrated
        else {},
        baseline_m=baseline_m,
    )
    return calibrate(views, nominal, expected, progress)


def refuse_other_board(reading: PictureReading) -> None:
    """Refuse pictures of which most show something else than the stated board.

    Raises:
        CalibrationError: names what they show.
    """
    views = reading.views
    if reading.hint:
        raise CalibrationError(f"the pictures show another board than {views.board}: {reading.hint}")
    if len(views.views) >= 0.5 * len(views.labels) and len(views.views):
        return
    count = reading.likely_count
    if count is not None:
        raise CalibrationError(
            f"the pictures show a board of {count[0]}x{count[1]} inner corners, not of {views.board.columns}x"
            f"{views.board.rows}: call again with --board {count[0]}x{count[1]} (count the points where squares meet)"
        )
    if reading.mirrored:
        raise CalibrationError(
            f"{', '.join(reading.mirrored[:3])}: the board is mirrored; switch the camera's mirroring off and take the "
            "pictures again"
        )
    if not views.views:
        raise CalibrationError(
            f"none of {len(views.labels)} pictures shows a {views.board}: is it wholly in the picture, sharp, evenly "
            "lit, with a white margin around it?"
        )
