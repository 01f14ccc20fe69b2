"""The search for one foot's blob among the points above the floor; `depth_blob` leads it and tells its purpose."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Final

import cv2
import numpy as np
from numpy.typing import NDArray

from rhot.geometry.camera import CameraModel
from rhot_feet.depth.points import Mask, PointGrid
from rhot_feet.depth.shape import FootShape, part_in_sight

FloatArray = NDArray[np.float64]

RADIUS_M: Final = 0.18
"""Of the cylinder about the marker: a whole shoe with room around it, else the cylinder would slide along the shoe."""
_FADE_M: Final = (0.02, 0.08)
"""Points so far above the marker begin to count less, and count nothing: were the shank cut off sharply, an error of a
centimetre in the expected height would shift the centroid by several."""
_BELOW_MARKER_M: Final = 0.16
"""Used where no floor is known: a foot in the air hangs down by so much."""
SETTLED_M: Final = 1e-3
MIN_POINTS: Final = 40
_LEAST_KNOWN: Final = 0.1
"""Share of a blob; of less than that nothing is told by comparing it."""


@dataclass(frozen=True, slots=True)
class BlobSeed:
    """Where a foot's blob is looked for.

    Attributes:
        place: (3,) expected place of the marker, metres, camera frame.
        offset: (3,) from the blob's centroid to the marker, metres, camera frame.
        shape: the foot's whole surface, camera axes, where it is known.
        fixed: the marker is seen: its place is what it is, only its points are wanted.
    """

    place: FloatArray
    offset: FloatArray
    shape: FootShape | None = None
    fixed: bool = False


@dataclass(frozen=True, slots=True)
class FootBlob:
    """A foot in the depth image.

    Attributes:
        place: (3,) of the marker as the blob tells it, metres, camera frame.
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

    place: FloatArray
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


class FootSearch:
    """Moves one foot's cylinder.

    Attributes:
        place: (3,) of the marker as it is believed by now, metres, camera frame.
        distances: (N,) of the points from the upright axis through that place, as of the last `measure`.
        moved_m: how far the place was moved last.
    """

    def __init__(self, seed: BlobSeed, solid: SolidPoints) -> None:
        """Begin at the expected place."""
        self._seed, self._solid = seed, solid
        self._weights = _weights(solid.levels - float(seed.place @ solid.up))
        self._member: Mask | None = None
        self._unknown: Mask = np.zeros(len(solid.points), dtype=np.bool_)
        self._in_sight, self._hidden_shift = 1.0, np.zeros(3)
        self.place = seed.place
        self.moved_m = 0.0
        self.measure()

    def measure(self) -> None:
        """Measure the distances from the present place."""
        difference = self._solid.points - self.place
        along = self._solid.levels - float(self.place @ self._solid.up)
        squared = np.einsum("ni,ni->n", difference, difference) - along**2
        self.distances: FloatArray = np.sqrt(np.maximum(squared, 0.0))

    def take_points(self, others: Iterable[FootSearch]) -> bool:
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
            self._in_sight, self._hidden_shift = part_in_sight(self._seed.shape, self.place, solid.grid, solid.camera)
        return True

    def tell_known(self) -> None:
        """Tell which of the points are of a part of the foot that was in sight when it was learnt."""
        if self._seed.shape is not None and self._member is not None:
            self._unknown = np.zeros(len(self._solid.points), dtype=np.bool_)
            self._unknown[self._member] = ~self._seed.shape.view.showed(self._solid.points[self._member] - self.place)

    def move(self, share: float) -> None:
        """Go so far to where the points say that the marker is, 1 = all the way."""
        place = self._centroid() + self._seed.offset
        place = share * place + (1.0 - share) * self.place
        self.moved_m, self.place = float(np.linalg.norm(place - self.place)), place

    def blob(self) -> FootBlob | None:
        """Return what was found."""
        if self._member is None:
            return None
        solid, member = self._solid, self._member
        inside, weights, compared = solid.points[member], self._weights[member], self._compared()[member]
        surface = weights * inside[:, 2] ** 2
        return FootBlob(
            self.place,
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
        """Tell which points are of the part of the foot that is known; all of them where hardly any would be."""
        member = self._member
        if member is None:
            raise RuntimeError("no points were taken")
        compared: Mask = member & ~self._unknown
        return compared if self._weights[compared].sum() >= _LEAST_KNOWN * self._weights[member].sum() else member

    def _centroid(self) -> FloatArray:
        compared = self._compared()
        centroid: FloatArray = np.average(self._solid.points[compared], axis=0, weights=self._weights[compared])
        return centroid + self._hidden_shift


def _weights(above_m: FloatArray) -> FloatArray:
    """Return how much points (N,) so far above the expected marker count, 0 to 1."""
    fading = (_FADE_M[1] - above_m) / (_FADE_M[1] - _FADE_M[0])
    weights: FloatArray = np.where(above_m > -_BELOW_MARKER_M, np.clip(fading, 0.0, 1.0), 0.0)
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
