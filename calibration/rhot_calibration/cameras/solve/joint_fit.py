"""Where a board stood that several cameras saw at once, when the cameras are known."""

from __future__ import annotations

import contextlib
from collections.abc import Mapping

from rhot.errors import CalibrationError
from rhot.geometry.rotations import inverse
from rhot_calibration.cameras.bundle.adjustment import Adjusted, BoardStand, Key, adjust_views
from rhot_calibration.cameras.solve.placement import pose_candidates
from rhot_calibration.cameras.solve.views import Board, BoardView


def fit_together(
    board: Board, adjusted: Adjusted, views: Mapping[Key, BoardView], widths: Mapping[str, int], scale: float = 1.0
) -> Adjusted | None:
    """Return where a board stood that several cameras saw at once; None when it can have stood nowhere.

    Args:
        board: what was shown.
        adjusted: lenses, cameras and the board's shape, which are held.
        views: by (camera, picture number), of one number.
        widths: of the pictures, pixels.
        scale: the board was so many times as large.
    """
    number = next(iter(views))[1]
    place: BoardStand = number, ""
    lenses = {name: adjusted.lens(name) for name in adjusted.cameras}
    cameras = {name: adjusted.T_camera_rig(name) for name in adjusted.cameras}
    corners = scale * adjusted.bundle.geometry.corners
    fits = []
    for key, view in views.items():
        # Started from every pose that a single view allows: the wrong one of a plane is a local minimum.
        for candidate in pose_candidates(scale * board.points[view.ids], view.corners, lenses[key[0]]):
            start = {place: inverse(cameras[key[0]]) @ candidate.T}
            with contextlib.suppress(CalibrationError):
                fits.append(
                    adjust_views(
                        board,
                        views,
                        dict.fromkeys(views, place),
                        lenses,
                        cameras,
                        start,
                        widths,
                        corners=corners,
                        hold=True,
                        sigma_px=adjusted.bundle.sigma_px,
                    )
                )
    return min(fits, key=lambda fit: fit.total_rms_px(), default=None)
