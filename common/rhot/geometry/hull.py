"""Convex bodies as planes: how far points lie outside of them, and what they look like.

A plane is (x, y, z, d): its unit normal leads out, and the body lies where normal · point ≤ d.

Who has a mesh's file meets its distances (`distance_grid`), others its convex hull. How far it, the bounding box and
the bounding cylinder are off the surface that a fingertip of 8 mm reaches, median and 95 %
(`tests/rhot/test_object_mesh.py` measures some of it again):

    mm               mug       bottle      bowl        pear       brick      hammer      ball
    64 planes     1.3  23    0.1 4.7    0.6  20    0.6  2.5    0.0  0.0    2.8  18    0.9  2.5
    box            13  32    4.7  19     18  34    9.1   20    0.0  0.0    3.2  20    8.1   16
    cylinder       19  39    0.6  17     15  33    5.4   18    5.1   24    7.4  21    4.1   13

What no convex body has stays wrong: the hole of a handle, the inside of a bowl, the angle between hammer and shaft.
"""

from __future__ import annotations

from itertools import combinations
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from rhot.arrays import FloatArray

# Rectangles of an image.


class Region(NamedTuple):
    """Columns left to right − 1 and rows top to bottom − 1 of an image, pixels."""

    left: int
    top: int
    right: int
    bottom: int

    @property
    def area(self) -> int:
        """Number of pixels."""
        return (self.right - self.left) * (self.bottom - self.top)

    def overlaps(self, other: Region) -> bool:
        """Return whether the regions have common pixels."""
        across = self.left < other.right and other.left < self.right
        return across and self.top < other.bottom and other.top < self.bottom

    def joined(self, other: Region) -> Region:
        """Return the smallest region that contains both."""
        return Region(
            min(self.left, other.left),
            min(self.top, other.top),
            max(self.right, other.right),
            max(self.bottom, other.bottom),
        )


_APART_DEG: Final = range(1, 91)
"""Angles that normals are made to keep, until few enough are left; the box's six keep 90° anyway."""
_PARALLEL: Final = 1e-6
"""Squared sine below which two planes have no edge that could be computed."""
_ON_M: Final = 1e-7
"""Rounding of planes and corners on the wire."""


def hull_planes(corners: FloatArray, most: int) -> FloatArray:
    """Return the planes (K, 4) of a body around points: those of the bounding box first, then of the largest faces.

    The planes are moved out until no point lies beyond: nothing can reach what is drawn without meeting them first.

    Args:
        corners: (N, 3) metres.
        most: planes at most, 6 of them the box's.

    Raises:
        ValueError: the points lie in one plane.
    """
    from scipy.spatial import ConvexHull, QhullError  # noqa: PLC0415  # only who reads a mesh needs scipy

    try:
        hull = ConvexHull(corners)
    except QhullError as error:
        raise ValueError("its corners lie in one plane") from error
    a, b, c = (corners[hull.simplices[:, k]] for k in range(3))
    area = np.linalg.norm(np.cross(b - a, c - a), axis=1)
    candidates = np.vstack([np.eye(3), -np.eye(3), hull.equations[np.argsort(-area, kind="stable"), :3]])
    # Of a fine mesh, far more faces than can be kept differ by next to nothing.
    candidates = candidates[np.sort(np.unique(np.round(candidates, 3), axis=0, return_index=True)[1])]
    for apart_deg in _APART_DEG:
        normals = _apart(candidates, np.cos(np.radians(apart_deg)), most)
        if len(normals) <= most:
            break
    return np.column_stack([normals, (corners[hull.vertices] @ normals.T).max(axis=0)])


def _apart(candidates: FloatArray, cosine: float, most: int) -> FloatArray:
    """Return unit vectors of which no two are nearer than an angle, the first ones first; few more than `most`."""
    free = np.ones(len(candidates), dtype=bool)
    kept: list[FloatArray] = []
    while free.any() and len(kept) <= most:
        kept.append(candidates[int(free.argmax())])
        free &= candidates @ kept[-1] < cosine
    return np.array(kept)


def plane_distance(planes: FloatArray, points: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return how far points lie outside of a convex body, and the way out.

    Exact inside, above faces and edges; beyond a corner it is that to the nearest edge's line, a little too small.

    Args:
        planes: (K, 4).
        points: (N, 3) metres.

    Returns:
        (N,) metres, negative inside, and (N, 3) unit vectors.
    """
    normals = planes[:, :3]
    beyond = points @ normals.T - planes[:, 3]
    first = np.argmax(beyond, axis=1)
    rows = np.arange(len(points))
    most = beyond[rows, first]
    # Onto the edge of two planes: x − λ₁n₁ − λ₂n₂ lies in both.
    cosine = normals[first] @ normals.T
    sine2 = np.maximum(1.0 - cosine**2, _PARALLEL)
    beside = beyond - cosine * most[:, None]
    at_edge = (beside > 0.0) & (1.0 - cosine**2 > _PARALLEL) & (most[:, None] > 0.0)
    squared = np.where(at_edge, most[:, None] ** 2 + beside**2 / sine2, 0.0)
    second = np.argmax(squared, axis=1)
    is_edge = squared[rows, second] > 0.0
    along_second = np.where(is_edge, beside[rows, second] / sine2[rows, second], 0.0)
    along_first = most - np.where(is_edge, cosine[rows, second], 0.0) * along_second
    way = along_first[:, None] * normals[first] + along_second[:, None] * normals[second]
    distance = np.where(is_edge, np.sqrt(squared[rows, second]), most)
    out = np.where(is_edge[:, None], way / np.maximum(distance, 1e-12)[:, None], normals[first])
    return distance, out


def hull_surface(planes: FloatArray) -> tuple[FloatArray, NDArray[np.int64]]:
    """Return the corners (N, 3), metres, and triangles (M, 3), counter-clockwise from outside, of a convex body."""
    normals, offsets = planes[:, :3], planes[:, 3]
    triples = np.array(list(combinations(range(len(planes)), 3)))
    matrices = normals[triples]
    meet = np.abs(np.linalg.det(matrices)) > _PARALLEL
    found = np.linalg.solve(matrices[meet], offsets[triples[meet]][..., None])[..., 0]
    found = found[(found @ normals.T <= offsets + 10.0 * _ON_M).all(axis=1)]
    # Where more than three planes meet, the corner is found again and again.
    corners = found[np.unique(np.round(found, 6), axis=0, return_index=True)[1]]
    triangles = []
    for normal, offset in zip(normals, offsets, strict=True):
        on = np.flatnonzero(np.abs(corners @ normal - offset) < 20.0 * _ON_M)
        if len(on) < 3:
            continue
        off = corners[on] - corners[on].mean(axis=0)
        first = np.linalg.svd(off)[2][0]
        angle = np.arctan2(off @ np.cross(normal, first), off @ first)
        ring = on[np.argsort(angle)]
        triangles += [(ring[0], ring[k], ring[k + 1]) for k in range(1, len(ring) - 1)]
    return corners, np.array(triangles, dtype=np.int64).reshape(-1, 3)
