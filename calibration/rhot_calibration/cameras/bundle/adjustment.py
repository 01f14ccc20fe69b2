"""From views and a rough placement to adjusted geometry: what `bundle` needs, built and taken apart by name."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Final

import numpy as np

from rhot.arrays import FloatArray
from rhot.geometry.transforms import rigid
from rhot_calibration.cameras.bundle.bundle import Bundle, adjust
from rhot_calibration.cameras.bundle.model import Geometry, Observations, Prior
from rhot_calibration.cameras.solve.views import Board, BoardView

Key = tuple[str, int]
Place = tuple[int, str]
"""Where the board stood: number of the pictures, and a camera's name where that camera's picture is on its own."""

LENS_SD: Final = np.array([0.15, 0.15, 0.04, 0.04, 0.5, 0.7, 0.005, 0.005, 0.2])
"""Standard deviations of what lenses are like: focal lengths and centre as shares of the width, then coefficients."""
_ASPECT_SD: Final = 0.001
"""Pixels are square to about this share."""
_PRINT_SHARE: Final = 0.01
"""A printed corner lies this share of a square beside its place, standard deviation …"""
_BOW_SHARE: Final = 0.02
"""… and this share of the board's diagonal above or below the plane."""


@dataclass(frozen=True, slots=True)
class Adjusted:
    """A bundle with its names.

    Attributes:
        cameras: names in order of the geometry.
        places: where the board stood, in order of the geometry.
        keys: (camera, picture number) of each view.
        observations: what was seen.
        bundle: the solution.
        released: whether the shape of the board was estimated.
    """

    cameras: tuple[str, ...]
    places: tuple[Place, ...]
    keys: tuple[Key, ...]
    observations: Observations
    bundle: Bundle
    released: bool

    @property
    def rms_px(self) -> dict[Key, float]:
        """Reprojection RMS of each view, pixels."""
        values = self.bundle.view_rms(self.observations.seen)
        return dict(zip(self.keys, values.tolist(), strict=True))

    def lens(self, camera: str) -> FloatArray:
        """Return the lens (9,) of a camera."""
        lens: FloatArray = self.bundle.geometry.lenses[self.cameras.index(camera)]
        return lens

    def T_camera_rig(self, camera: str) -> FloatArray:
        """Return the pose (4, 4) of a camera."""
        index = self.cameras.index(camera)
        return rigid(self.bundle.geometry.camera_R[index], self.bundle.geometry.camera_t[index])

    def T_rig_board(self, place: Place) -> FloatArray:
        """Return the pose (4, 4) of the board at a place."""
        index = self.places.index(place)
        return rigid(self.bundle.geometry.board_R[index], self.bundle.geometry.board_t[index])

    def total_rms_px(self) -> float:
        """Return the reprojection RMS over all corners, pixels."""
        seen = self.observations.seen
        return float(np.sqrt(np.sum(self.bundle.residuals[seen] ** 2) / max(int(seen.sum()), 1)))


def adjust_views(
    board: Board,
    views: Mapping[Key, BoardView],
    place_of: Mapping[Key, Place],
    lenses: Mapping[str, FloatArray],
    camera_poses: Mapping[str, FloatArray],
    board_poses: Mapping[Place, FloatArray],
    widths: Mapping[str, int],
    *,
    corners: FloatArray | None = None,
    release: bool = False,
    hold: bool = False,
    sigma_px: float = 1.0,
) -> Adjusted:
    """Adjust cameras and places together.

    Args:
        board: what was shown.
        views: by (camera, picture number).
        place_of: at which place each view saw the board.
        lenses: (9,) to start with, by camera; the order of the cameras, the first is the reference.
        camera_poses: T_camera_rig (4, 4) to start with.
        board_poses: T_rig_board (4, 4) to start with.
        widths: of the pictures, pixels.
        corners: (N, 3) to start with, metres; the flat board when not given.
        release: estimate the corners too.
        hold: lenses, cameras and corners are known; estimate only where the board stood.
        sigma_px: spread of the corners to start with.

    Raises:
        CalibrationError: the views do not determine the parameters.
    """
    cameras = tuple(lenses)
    keys = tuple(views)
    places = tuple(dict.fromkeys(place_of[key] for key in keys))
    observations = _observations(
        board, [views[key] for key in keys], keys, cameras, [place_of[key] for key in keys], places
    )
    start = Geometry(
        lenses=np.stack([lenses[name] for name in cameras]),
        camera_R=np.stack([camera_poses[name][:3, :3] for name in cameras]),
        camera_t=np.stack([camera_poses[name][:3, 3] for name in cameras]),
        board_R=np.stack([board_poses[place][:3, :3] for place in places]),
        board_t=np.stack([board_poses[place][:3, 3] for place in places]),
        corners=board.points if corners is None else corners,
    )
    prior = _prior(board, start, cameras, widths, release)
    if hold:
        prior = replace(prior, lens_sd=np.zeros_like(prior.lens_sd), cameras_held=True)
    bundle = adjust(start, observations, prior, sigma_px=sigma_px)
    return Adjusted(cameras, places, keys, observations, bundle, release)


def _observations(
    board: Board,
    seen: Sequence[BoardView],
    keys: Sequence[Key],
    cameras: Sequence[str],
    at: Sequence[Place],
    places: Sequence[Place],
) -> Observations:
    count = board.columns * board.rows
    uv, mask = np.zeros((len(seen), count, 2)), np.zeros((len(seen), count), dtype=bool)
    for row, view in enumerate(seen):
        uv[row, view.ids] = view.corners
        mask[row, view.ids] = True
    place_index = {place: index for index, place in enumerate(places)}
    return Observations(
        camera=np.array([cameras.index(camera) for camera, _ in keys], dtype=np.int64),
        place=np.array([place_index[place] for place in at], dtype=np.int64),
        uv=uv,
        seen=mask,
    )


def _prior(board: Board, start: Geometry, cameras: Sequence[str], widths: Mapping[str, int], release: bool) -> Prior:
    expected = np.zeros_like(start.lenses)
    # Wherever the focal length starts, it is expected there: its prior is only to keep the descent in bounds.
    expected[:, :2] = start.lenses[:, :2].mean(axis=1, keepdims=True)
    expected[:, 2:4] = start.lenses[:, 2:4]
    width = float(np.mean([widths[name] for name in cameras]))
    sd = LENS_SD * np.where(np.arange(9) < 4, width, 1.0)
    if not release:
        return Prior(expected, sd, _ASPECT_SD, board.points, None)
    diagonal = board.square_m * float(np.hypot(board.columns - 1, board.rows - 1))
    in_plane = _PRINT_SHARE * board.square_m
    return Prior(expected, sd, _ASPECT_SD, board.points, np.array([in_plane, in_plane, _BOW_SHARE * diagonal]))
