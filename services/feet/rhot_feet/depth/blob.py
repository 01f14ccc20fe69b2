"""Both feet's blobs in the depth image, cut out together near their expected places.

A foot is what stands above the floor within a cylinder about its marker and reaches not much higher than it: the shank,
which looks alike all the way up, is left out. Where the two cylinders meet, each point goes to the nearer foot, so that
feet side by side stay two. The cylinder is moved to where its own content says that the marker is, until it stays; its
height stays as it was expected, for a cylinder that rises lets in ever more of the shank. Of a foot that is partly
hidden, or shows a side that was never seen, only what is in sight and known is compared (`depth_shape`).
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Final

import cv2
import numpy as np
from numpy.typing import NDArray

from rhot.geometry.camera import CameraModel
from rhot.messages import Side
from rhot_feet.depth.floor import FloorPlane
from rhot_feet.depth.points import PointGrid
from rhot_feet.depth.search import MIN_POINTS, SETTLED_M, BlobSeed, FootBlob, FootSearch, SolidPoints

FloatArray = NDArray[np.float64]

_FLOOR_CLEARANCE_M: Final = 0.015
_FLOOR_NOISE: Final = 0.008
"""Clearance from the floor grows by so much times the depth squared, as its noise does."""
_ROUNDS: Final = 10
_FULL_ROUNDS: Final = 4
"""After so many the steps are halved: where points come in and go out again, the search would swing."""
_KERNEL: Final = np.ones((3, 3), np.uint8)


def find_blobs(
    grid: PointGrid,
    seeds: Mapping[Side, BlobSeed],
    floor: FloorPlane | None,
    up_camera: FloatArray,
    camera: CameraModel,
) -> dict[Side, FootBlob]:
    """Return the blobs of the feet; one of which too little is in sight is absent.

    Args:
        grid: points of a region that holds all cylinders.
        seeds: foot to where it is looked for.
        floor: the floor, where it is known.
        up_camera: (3,) unit vector out of the floor or against gravity, camera frame.
        camera: the lens.
    """
    solid = _solid_points(grid, floor, up_camera, camera)
    if len(solid.points) < MIN_POINTS:
        return {}
    feet = {side: FootSearch(seed, solid) for side, seed in seeds.items()}
    others = {side: [foot for other, foot in feet.items() if other != side] for side in feet}
    searched = [side for side, seed in seeds.items() if not seed.fixed]
    for turn in range(_ROUNDS):
        for side in searched:
            if feet[side].moved_m > 0.0:
                feet[side].measure()
        for side in searched:
            if not feet[side].take_points(others[side]):
                continue
            if turn < _FULL_ROUNDS:
                feet[side].tell_known()
            feet[side].move(1.0 if turn < _FULL_ROUNDS else 0.5)
        if all(feet[side].moved_m < SETTLED_M for side in searched):
            break
    # Feet whose place is given need their points alone, when the others have found theirs.
    for side, seed in seeds.items():
        if seed.fixed and feet[side].take_points(others[side]):
            feet[side].tell_known()
    blobs = {side: foot.blob() for side, foot in feet.items()}
    return {side: blob for side, blob in blobs.items() if blob is not None}


def _solid_points(grid: PointGrid, floor: FloorPlane | None, up_camera: FloatArray, camera: CameraModel) -> SolidPoints:
    solid = grid.valid.copy()
    if floor is not None:
        clearance = _FLOOR_CLEARANCE_M + _FLOOR_NOISE * grid.points[..., 2] ** 2
        solid &= floor.heights_m(grid.points) > clearance
    solid = cv2.morphologyEx(solid.astype(np.uint8), cv2.MORPH_OPEN, _KERNEL).astype(np.bool_)
    rows, columns = np.nonzero(solid)
    points = grid.points[rows, columns]
    return SolidPoints(grid, camera, up_camera, rows, columns, points, points @ up_camera)
