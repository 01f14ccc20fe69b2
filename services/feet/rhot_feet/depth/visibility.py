"""Visible part of a foot's surface, which the other knee and the foot's own shank often occlude.

The centroid of the visible part differs from that of the whole foot. So the surface is stored as points. Points with
something nearer, or no depth, in the depth image are occluded, and the blob's centroid is compared with the mean of the
others.

Conversely, a rotating foot shows a side that was occluded when its surface was recorded: the shank occludes the heel
until that is lifted. So the depth image of the recording is stored as well, and points that would have been occluded in
it are not compared.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Final

import numpy as np

from rhot.arrays import FloatArray
from rhot.geometry.camera import CameraModel
from rhot_feet.depth.points import FINE_PX, Mask, PointGrid

_NEARER_THEN_M: Final = 0.02
"""The same in the image of the recording; smaller, because the shank meets the instep without a gap."""


@dataclass(frozen=True, slots=True)
class SurfaceView:
    """The depth image in which a foot's surface was learned.

    Attributes:
        grid: its points, `FINE_PX` apart.
        camera: its lens.
        position: (3,) of the marker in it, metres, its camera's frame.
        R: (3, 3) from the axes of the shape to those of its camera.
    """

    grid: PointGrid
    camera: CameraModel
    position: FloatArray
    R: FloatArray

    def revealed(self, points: FloatArray) -> Mask:
        """Return which points (N, 3), relative to the marker, metres, axes of the shape, were not occluded in it."""
        return _visible(points @ self.R.T + self.position, self.grid, self.camera, _NEARER_THEN_M)


@dataclass(frozen=True, slots=True)
class SurfaceShape:
    """A foot's surface as the depth image showed it.

    Attributes:
        points: (N, 3) from the marker, metres, foot frame or camera frame.
        weights: (N,) how much they counted in the blob.
        area: surface of all of the blob, see `FootBlob.whole_area`.
        view: where it was seen.
    """

    points: FloatArray
    weights: FloatArray
    area: float
    view: SurfaceView

    @property
    def mean(self) -> FloatArray:
        """(3,) weighted mean of the points."""
        mean: FloatArray = self.weights @ self.points / self.weights.sum()
        return mean

    def rotated(self, R: FloatArray) -> SurfaceShape:
        """Return the shape in other axes, which R (3, 3) maps to."""
        view = replace(self.view, R=self.view.R @ R.T)
        return SurfaceShape(self.points @ R.T, self.weights, self.area, view)


def sample_shape(points: FloatArray, weights: FloatArray, area: float, view: SurfaceView) -> SurfaceShape:
    """Return the shape of a blob's points (N, 3) from the marker with weights (N,), a sample of them."""
    # Number of points of a foot's model that are compared with an image; chosen.
    every = max(1, len(points) // 150)
    return SurfaceShape(points[::every], weights[::every], area, view)


def visible_part(
    shape: SurfaceShape, position: FloatArray, grid: PointGrid, camera: CameraModel
) -> tuple[float, FloatArray]:
    """Return the visible share of a foot's surface, and the offset from the mean of that part to the mean of all.

    Args:
        shape: in the camera's axes.
        position: (3,) of the marker, metres, camera frame.
        grid: the points of the depth image about it, `FINE_PX` apart.
        camera: the lens.

    Returns:
        0 to 1; (3,) metres, camera frame, zero if nothing is visible.
    """
    # Smallest difference in depth of an occluding object.
    clear = _visible(shape.points + position, grid, camera, 0.04)
    weights = np.where(clear, shape.weights, 0.0)
    share = float(weights.sum() / shape.weights.sum())
    if share <= 0.0:
        return 0.0, np.zeros(3)
    return share, shape.mean - weights @ shape.points / weights.sum()


def _visible(points: FloatArray, grid: PointGrid, camera: CameraModel, nearer_m: float) -> Mask:
    """Return which points (N, 3), camera frame, metres, have nothing nearer by `nearer_m` in a depth image."""
    pixels = camera.project(points)
    columns = np.rint((pixels[:, 0] - grid.region.left) / FINE_PX).astype(np.intp)
    rows = np.rint((pixels[:, 1] - grid.region.top) / FINE_PX).astype(np.intp)
    height, width = grid.valid.shape
    inside = (columns >= 0) & (columns < width) & (rows >= 0) & (rows < height)
    rows, columns = np.where(inside, rows, 0), np.where(inside, columns, 0)
    clear: Mask = inside & grid.valid[rows, columns] & (grid.points[rows, columns, 2] > points[:, 2] - nearer_m)
    return clear
