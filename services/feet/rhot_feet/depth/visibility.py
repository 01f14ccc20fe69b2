"""Which part of a foot's surface is in sight: the other leg's knee and its own shank often stand before it.

The centroid of what remains lies elsewhere in the foot than that of the whole. So the surface is remembered as points;
those before which the depth image shows something nearer, or nothing, are hidden, and the others' mean is what the
blob's centroid has to be compared with.

The other way round, a foot that turns shows a side that was hidden when its surface was recorded: the shank stands
before the heel until that is lifted. So the depth image of that moment is remembered, too, and a point that would have
lain behind something in it is not compared.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Final

import numpy as np

from rhot.arrays import FloatArray
from rhot.geometry.camera import CameraModel
from rhot_feet.depth.points import FINE_PX, Mask, PointGrid

_POINTS: Final = 150
"""Of a foot's model that are looked for in a picture; chosen."""
_NEARER_M: Final = 0.04
"""What is nearer than a point by more than this stands before it."""
_NEARER_THEN_M: Final = 0.02
"""The same of what was there when the model was made: the shank meets the instep without a gap."""


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
        """Tell of which points (N, 3) from the marker, axes of the shape, it showed whether there was something."""
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
    every = max(1, len(points) // _POINTS)
    return SurfaceShape(points[::every], weights[::every], area, view)


def visible_part(
    shape: SurfaceShape, position: FloatArray, grid: PointGrid, camera: CameraModel
) -> tuple[float, FloatArray]:
    """Return the share of a foot's surface that is in sight, and from the mean of that part to the mean of all.

    Args:
        shape: in the camera's axes.
        position: (3,) of the marker, metres, camera frame.
        grid: the points of the depth image about it, `FINE_PX` apart.
        camera: the lens.

    Returns:
        0 to 1; (3,) metres, camera frame, zero where nothing is in sight.
    """
    clear = _visible(shape.points + position, grid, camera, _NEARER_M)
    weights = np.where(clear, shape.weights, 0.0)
    share = float(weights.sum() / shape.weights.sum())
    if share <= 0.0:
        return 0.0, np.zeros(3)
    return share, shape.mean - weights @ shape.points / weights.sum()


def _visible(points: FloatArray, grid: PointGrid, camera: CameraModel, nearer_m: float) -> Mask:
    """Return before which points (N, 3), camera frame, nothing stands in a depth image that is nearer by so much."""
    pixels = camera.project(points)
    columns = np.rint((pixels[:, 0] - grid.region.left) / FINE_PX).astype(np.intp)
    rows = np.rint((pixels[:, 1] - grid.region.top) / FINE_PX).astype(np.intp)
    height, width = grid.valid.shape
    inside = (columns >= 0) & (columns < width) & (rows >= 0) & (rows < height)
    rows, columns = np.where(inside, rows, 0), np.where(inside, columns, 0)
    clear: Mask = inside & grid.valid[rows, columns] & (grid.points[rows, columns, 2] > points[:, 2] - nearer_m)
    return clear
