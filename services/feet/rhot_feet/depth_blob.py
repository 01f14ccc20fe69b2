"""Both feet's blobs in the depth image, cut out together near their expected places.

A foot is what stands above the floor within a cylinder about its marker and reaches not much higher than it: the shank,
which looks alike all the way up, is left out. Where the two cylinders meet, each point goes to the nearer foot, so that
feet side by side stay two. The cylinder is moved to where its own content says that the marker is, until it stays; its
height stays as it was expected, for a cylinder that rises lets in ever more of the shank. Of a foot that is partly
hidden only the part in sight is compared (`depth_shape`).
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Final

import cv2
import numpy as np
from numpy.typing import NDArray

from rhot.camera import CameraModel
from rhot.messages import Side
from rhot_feet.depth_floor import FloorPlane
from rhot_feet.depth_points import Mask, PointGrid
from rhot_feet.depth_shape import FootShape, part_in_sight

FloatArray = NDArray[np.float64]

RADIUS_M: Final = 0.18
"""Of the cylinder about the marker: a whole shoe with room around it, else the cylinder would slide along the shoe."""
_FADE_M: Final = (0.02, 0.08)
"""Points so far above the marker begin to count less, and count nothing: were the shank cut off sharply, an error of a
centimetre in the expected height would shift the centroid by several."""
_BELOW_MARKER_M: Final = 0.16
"""Used where no floor is known: a foot in the air hangs down by so much."""
_FLOOR_CLEARANCE_M: Final = 0.015
_FLOOR_NOISE: Final = 0.008
"""Clearance from the floor grows by so much times the depth squared, as its noise does."""
_ROUNDS: Final = 10
_FULL_ROUNDS: Final = 4
"""After so many the steps are halved: where points come in and go out again, the search would swing."""
_SETTLED_M: Final = 1e-3
_MIN_POINTS: Final = 40
_LEAST_KNOWN: Final = 0.1
"""Share of a blob; of less than that nothing is told by comparing it."""
_KERNEL: Final = np.ones((3, 3), np.uint8)


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
    solid = grid.valid.copy()
    if floor is not None:
        clearance = _FLOOR_CLEARANCE_M + _FLOOR_NOISE * grid.points[..., 2] ** 2
        solid &= floor.heights_m(grid.points) > clearance
    solid = cv2.morphologyEx(solid.astype(np.uint8), cv2.MORPH_OPEN, _KERNEL).astype(np.bool_)
    rows, columns = np.nonzero(solid)
    points = grid.points[rows, columns]
    if len(points) < _MIN_POINTS:
        return {}
    levels = points @ up_camera
    weights = {side: _weights(levels - float(seed.place @ up_camera)) for side, seed in seeds.items()}
    places = {side: seed.place for side, seed in seeds.items()}
    distances = {side: _distances(points, levels, place, up_camera) for side, place in places.items()}
    members: dict[Side, Mask] = {}
    moved: dict[Side, float] = dict.fromkeys(seeds, 0.0)
    in_sight: dict[Side, float] = dict.fromkeys(seeds, 1.0)
    unknown: dict[Side, Mask] = {}
    hidden_shift: dict[Side, FloatArray] = dict.fromkeys(seeds, np.zeros(3))
    searched = [side for side, seed in seeds.items() if not seed.fixed]
    for turn in range(_ROUNDS):
        distances |= {
            side: _distances(points, levels, places[side], up_camera) for side in searched if moved[side] > 0.0
        }
        for side in searched:
            seed = seeds[side]
            member = _member(distances, side, rows, columns, solid.shape, weights[side])
            if member is None:
                members.pop(side, None)
                moved[side] = 0.0
                continue
            members[side] = member
            if seed.shape is not None:
                in_sight[side], hidden_shift[side] = part_in_sight(seed.shape, places[side], grid, camera)
            if turn < _FULL_ROUNDS:
                unknown[side] = _unknown(seed, places[side], points, member)
            compared = _compared(member, unknown[side], weights[side])
            place = np.average(points[compared], axis=0, weights=weights[side][compared])
            place += hidden_shift[side] + seed.offset
            if turn >= _FULL_ROUNDS:
                place = 0.5 * (place + places[side])
            moved[side] = float(np.linalg.norm(place - places[side]))
            places[side] = place
        if all(step < _SETTLED_M for step in moved.values()):
            break
    # Feet whose place is given need their points alone, when the others have found theirs.
    for side, seed in seeds.items():
        member = _member(distances, side, rows, columns, solid.shape, weights[side]) if seed.fixed else None
        if member is not None:
            members[side], unknown[side] = member, _unknown(seed, seed.place, points, member)
            if seed.shape is not None:
                in_sight[side], hidden_shift[side] = part_in_sight(seed.shape, seed.place, grid, camera)
    blobs: dict[Side, FootBlob] = {}
    for side, member in members.items():
        inside, share = points[member], weights[side][member]
        compared = _compared(member, unknown[side], weights[side])[member]
        surface = share * inside[:, 2] ** 2
        blobs[side] = FootBlob(
            places[side],
            np.average(inside[compared], axis=0, weights=share[compared]) + hidden_shift[side],
            inside,
            share,
            compared,
            float(surface[compared].sum()),
            float(surface.sum()),
            in_sight[side],
            _cut(grid, rows[member], columns[member], camera),
            moved[side] < 10.0 * _SETTLED_M,
        )
    return blobs


def _unknown(seed: BlobSeed, place: FloatArray, points: FloatArray, member: Mask) -> Mask:
    """Tell which members among points (N, 3) are of a part that was not in sight when the foot was learnt.

    Args:
        seed: the foot.
        place: (3,) where it is taken to be.
        points: all.
        member: (N,) those of the foot.
    """
    unknown: Mask = np.zeros(len(points), dtype=np.bool_)
    if seed.shape is not None:
        unknown[member] = ~seed.shape.view.showed(points[member] - place)
    return unknown


def _compared(member: Mask, unknown: Mask, weights: FloatArray) -> Mask:
    """Tell which points of a foot are of the part of it that is known; all of them where hardly any would be."""
    compared: Mask = member & ~unknown
    return compared if weights[compared].sum() >= _LEAST_KNOWN * weights[member].sum() else member


def _distances(points: FloatArray, levels: FloatArray, place: FloatArray, up: FloatArray) -> FloatArray:
    """Return the distances (N,) of points (N, 3) from the upright axis through a place."""
    difference = points - place
    along = levels - float(place @ up)
    squared = np.einsum("ni,ni->n", difference, difference) - along**2
    distances: FloatArray = np.sqrt(np.maximum(squared, 0.0))
    return distances


def _weights(above_m: FloatArray) -> FloatArray:
    """Return how much points (N,) so far above the expected marker count, 0 to 1."""
    fading = (_FADE_M[1] - above_m) / (_FADE_M[1] - _FADE_M[0])
    weights: FloatArray = np.where(above_m > -_BELOW_MARKER_M, np.clip(fading, 0.0, 1.0), 0.0)
    return weights


def _near(distances: Mapping[Side, FloatArray], side: Side) -> Mask:
    """Tell which points stand in a foot's cylinder, and nearer to it than to the other one."""
    near: Mask = distances[side] < RADIUS_M
    for other, distance in distances.items():
        if other != side:
            near &= distances[side] < distance
    return near


def _member(
    distances: Mapping[Side, FloatArray],
    side: Side,
    rows: NDArray[np.intp],
    columns: NDArray[np.intp],
    shape: tuple[int, ...],
    weights: FloatArray,
) -> Mask | None:
    """Tell which points are a foot's; None when they are too few."""
    # Shoe and heel hang together by way of the shank, which itself does not count.
    member: Mask = _connected(_near(distances, side), rows, columns, shape, weights) & (weights > 0.0)
    return member if member.sum() >= _MIN_POINTS else None


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
