"""Cutting both feet out of the depth image, together, near their predicted positions.

A foot is what stands above the floor within a cylinder about its marker and reaches not much higher than it: the shank,
which looks alike all the way up, is left out. Where the two cylinders meet, each point goes to the nearer foot, so that
feet side by side stay two. The cylinder moves to where its own content puts the marker, until it settles; its height
stays as predicted, for a cylinder that rises lets in ever more of the shank. Of a foot that is partly hidden, or shows
a side that was never seen, only what is visible and known is compared (`visibility`).
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from typing import Final

import cv2
import numpy as np
from numpy.typing import NDArray

from rhot.arrays import FloatArray
from rhot.geometry.camera import CameraModel
from rhot.types import Side
from rhot_feet.depth.plane import FINE_PX, FloorPlane, Mask, PointGrid

# Visible part of a foot's surface, which the other knee and the foot's own shank often occlude.
#
# The centroid of the visible part differs from that of the whole foot. So the surface is stored as points. Points
# with something nearer, or no depth, in the depth image are occluded, and the blob's centroid is compared with the
# mean of the others.
#
# Conversely, a rotating foot shows a side that was occluded when its surface was recorded: the shank occludes the
# heel until that is lifted. So the depth image of the recording is stored as well, and points that would have been
# occluded in it are not compared.

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


_ROUNDS: Final = 10
"""Most steps of the search for a centroid; chosen."""
_FULL_ROUNDS: Final = 4
"""After so many the steps are halved: where points come in and go out again, the search would swing."""
_KERNEL: Final = np.ones((3, 3), np.uint8)
RADIUS_M: Final = 0.18
"""Of the cylinder about the marker: a whole shoe with room around it, else the cylinder would slide along the shoe."""
_FADE_M: Final = (0.02, 0.08)
"""Points so far above the marker begin to count less, and count nothing: were the shank cut off sharply, an error of a
centimetre in the expected height would shift the centroid by several."""
SETTLED_M: Final = 1e-3
"""A search has settled when its last step was shorter."""
MIN_POINTS: Final = 40
"""Fewer points are no foot: a shoe 1.5 m away has about 500 of these, one for four pixels. Chosen."""


@dataclass(frozen=True, slots=True)
class BlobSeed:
    """Where a foot's blob is looked for.

    Attributes:
        position: (3,) expected position of the marker, metres, camera frame.
        offset: (3,) from the blob's centroid to the marker, metres, camera frame.
        shape: the foot's whole surface, camera axes, where it is known.
        fixed: the marker is seen: its position is what it is, only its points are wanted.
    """

    position: FloatArray
    offset: FloatArray
    shape: SurfaceShape | None = None
    fixed: bool = False


@dataclass(frozen=True, slots=True)
class FootBlob:
    """A foot in the depth image.

    Attributes:
        position: (3,) of the marker as the blob shows it, metres, camera frame.
        centroid: (3,) of those of the blob's points that are compared, moved to where that of the known foot would be.
        points: (N, 3) of the blob.
        weights: (N,) how much they count.
        compared: (N,) they are of the part of the foot that is known; all while its shape is not.
        area: weighted sum of the squared depths of those that are compared, proportional to the surface seen.
        whole_area: the same of all.
        in_sight: 0 to 1, share of the foot's surface before which nothing stands; 1 while its shape is not known.
        cut: 0 to 1, share of its points at the picture's edge: some of the foot is out of sight.
        settled: the search came to rest.
    """

    position: FloatArray
    centroid: FloatArray
    points: FloatArray
    weights: FloatArray
    compared: Mask
    area: float
    whole_area: float
    in_sight: float
    cut: float
    settled: bool


@dataclass(frozen=True, slots=True)
class SolidPoints:
    """What stands above the floor.

    Attributes:
        grid: all points of the region.
        camera: the lens.
        up: (3,) unit vector out of the floor or against gravity, camera frame.
        rows, columns: (N,) where in the grid the points are.
        points: (N, 3) metres, camera frame.
        levels: (N,) their heights, metres, from the camera.
    """

    grid: PointGrid
    camera: CameraModel
    up: FloatArray
    rows: NDArray[np.intp]
    columns: NDArray[np.intp]
    points: FloatArray
    levels: FloatArray


class BlobSearch:
    """Moves one foot's cylinder.

    Attributes:
        position: (3,) of the marker as it is believed by now, metres, camera frame.
        distances: (N,) of the points from the upright axis through that position, as of the last `measure`.
        moved_m: how far the position was moved last.
    """

    def __init__(self, seed: BlobSeed, solid: SolidPoints) -> None:
        """Begin at the expected position."""
        self._seed, self._solid = seed, solid
        self._weights = _weights(solid.levels - float(seed.position @ solid.up))
        self._member: Mask | None = None
        self._unknown: Mask = np.zeros(len(solid.points), dtype=np.bool_)
        self._in_sight, self._hidden_shift = 1.0, np.zeros(3)
        self.position = seed.position
        self.moved_m = 0.0
        self.measure()

    def measure(self) -> None:
        """Measure the distances from the present position."""
        difference = self._solid.points - self.position
        along = self._solid.levels - float(self.position @ self._solid.up)
        squared = np.einsum("ni,ni->n", difference, difference) - along**2
        self.distances: FloatArray = np.sqrt(np.maximum(squared, 0.0))

    def select_points(self, others: Iterable[BlobSearch]) -> bool:
        """Take the points in the cylinder that are nearer to it than to other feet's; False where they are too few."""
        solid = self._solid
        near: Mask = self.distances < RADIUS_M
        for other in others:
            near &= self.distances < other.distances
        # Shoe and heel hang together by way of the shank, which itself does not count.
        shape = solid.grid.valid.shape
        member: Mask = _connected(near, solid.rows, solid.columns, shape, self._weights) & (self._weights > 0.0)
        self._member = member if member.sum() >= MIN_POINTS else None
        if self._member is None:
            self.moved_m = 0.0
            return False
        if self._seed.shape is not None:
            self._in_sight, self._hidden_shift = visible_part(self._seed.shape, self.position, solid.grid, solid.camera)
        return True

    def mark_unknown(self) -> None:
        """Return which of the points are of a part of the foot that was in sight when it was learned."""
        if self._seed.shape is not None and self._member is not None:
            self._unknown = np.zeros(len(self._solid.points), dtype=np.bool_)
            self._unknown[self._member] = ~self._seed.shape.view.revealed(
                self._solid.points[self._member] - self.position
            )

    def move(self, share: float) -> None:
        """Go so far to where the points say that the marker is, 1 = all the way."""
        position = self._centroid() + self._seed.offset
        position = share * position + (1.0 - share) * self.position
        self.moved_m, self.position = float(np.linalg.norm(position - self.position)), position

    def blob(self) -> FootBlob | None:
        """Return what was found."""
        if self._member is None:
            return None
        solid, member = self._solid, self._member
        inside, weights, compared = solid.points[member], self._weights[member], self._compared()[member]
        surface = weights * inside[:, 2] ** 2
        return FootBlob(
            self.position,
            self._centroid(),
            inside,
            weights,
            compared,
            float(surface[compared].sum()),
            float(surface.sum()),
            self._in_sight,
            _cut(solid.grid, solid.rows[member], solid.columns[member], solid.camera),
            self.moved_m < 10.0 * SETTLED_M,
        )

    def _compared(self) -> Mask:
        """Return which points are of the part of the foot that is known; all of them where hardly any would be."""
        member = self._member
        if member is None:
            raise RuntimeError("no points were taken")
        compared: Mask = member & ~self._unknown
        # Share of a blob; comparing less says nothing.
        return compared if self._weights[compared].sum() >= 0.1 * self._weights[member].sum() else member

    def _centroid(self) -> FloatArray:
        compared = self._compared()
        centroid: FloatArray = np.average(self._solid.points[compared], axis=0, weights=self._weights[compared])
        return centroid + self._hidden_shift


def _weights(above_m: FloatArray) -> FloatArray:
    """Return how much points (N,) so far above the expected marker count, 0 to 1."""
    fading = (_FADE_M[1] - above_m) / (_FADE_M[1] - _FADE_M[0])
    # Used where no floor is known: a foot in the air hangs down by so much.
    weights: FloatArray = np.where(above_m > -0.16, np.clip(fading, 0.0, 1.0), 0.0)
    return weights


def _connected(
    near: Mask, rows: NDArray[np.intp], columns: NDArray[np.intp], shape: tuple[int, ...], weights: FloatArray
) -> Mask:
    """Return those of the near points that lie in the connected component with most weight."""
    picture = np.zeros(shape, np.uint8)
    picture[rows[near], columns[near]] = 1
    count, labels = cv2.connectedComponents(picture, connectivity=8, ltype=cv2.CV_16U)
    if count <= 2:
        return near
    of_point = labels[rows, columns]
    totals = np.bincount(of_point, weights=np.where(near, weights, 0.0), minlength=count)
    totals[0] = 0.0
    chosen: Mask = near & (of_point == int(np.argmax(totals)))
    return chosen


def _cut(grid: PointGrid, rows: NDArray[np.intp], columns: NDArray[np.intp], camera: CameraModel) -> float:
    """Return the share of a blob's points that lie at the picture's edge, against what its outline would have there."""
    height, width = grid.valid.shape
    edge = np.zeros(len(rows), dtype=np.bool_)
    if grid.region.left <= 0:
        edge |= columns <= 1
    if grid.region.top <= 0:
        edge |= rows <= 1
    if grid.region.right >= camera.width:
        edge |= columns >= width - 2
    if grid.region.bottom >= camera.height:
        edge |= rows >= height - 2
    return min(1.0, float(edge.sum()) / float(np.sqrt(len(rows))))


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
    feet = {side: BlobSearch(seed, solid) for side, seed in seeds.items()}
    others = {side: [foot for other, foot in feet.items() if other != side] for side in feet}
    searched = [side for side, seed in seeds.items() if not seed.fixed]
    for turn in range(_ROUNDS):
        for side in searched:
            if feet[side].moved_m > 0.0:
                feet[side].measure()
        for side in searched:
            if not feet[side].select_points(others[side]):
                continue
            if turn < _FULL_ROUNDS:
                feet[side].mark_unknown()
            feet[side].move(1.0 if turn < _FULL_ROUNDS else 0.5)
        if all(feet[side].moved_m < SETTLED_M for side in searched):
            break
    # Feet whose position is given need their points alone, when the others have found theirs.
    for side, seed in seeds.items():
        if seed.fixed and feet[side].select_points(others[side]):
            feet[side].mark_unknown()
    blobs = {side: foot.blob() for side, foot in feet.items()}
    return {side: blob for side, blob in blobs.items() if blob is not None}


def _solid_points(grid: PointGrid, floor: FloorPlane | None, up_camera: FloatArray, camera: CameraModel) -> SolidPoints:
    solid = grid.valid.copy()
    if floor is not None:
        # What is nearer to the floor than this counts as floor: half of a sole's thickness. Chosen.
        # Clearance from the floor grows by so much times the depth squared, as its noise does.
        clearance = 0.015 + 0.008 * grid.points[..., 2] ** 2
        solid &= floor.heights_m(grid.points) > clearance
    solid = cv2.morphologyEx(solid.astype(np.uint8), cv2.MORPH_OPEN, _KERNEL).astype(np.bool_)
    rows, columns = np.nonzero(solid)
    points = grid.points[rows, columns]
    return SolidPoints(grid, camera, up_camera, rows, columns, points, points @ up_camera)
