"""Signed distances from a surface of any shape, made once on a grid.

A convex hull has no hole for the fingers that close round a handle. Distances at the nodes of a grid have, and between
the nodes they are interpolated with the way out (the gradient) in the same few operations.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Final

import numpy as np

from rhot.arrays import FloatArray, IntArray

_NODES: Final = 48
"""Steps along the longest edge of the body: 2.5 mm for a mug."""
_LEAST_STEP_M: Final = 0.0015
_MARGIN: Final = 4
"""Steps that the grid reaches beyond the body."""
_CORNERS: Final = np.array([[i, j, k] for i in (0, 1) for j in (0, 1) for k in (0, 1)])


@dataclass(frozen=True, slots=True)
class DistanceGrid:
    """Signed distances at the nodes of a grid, the body's own axes.

    Attributes:
        low_m: (3,) the first node.
        step_m: between nodes.
        values: (X, Y, Z) metres at each node, negative inside.
    """

    low_m: FloatArray
    step_m: float
    values: FloatArray

    def distance(self, points: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return the distances (N,) of points (N, 3), metres, and the way out (N, 3), unit.

        Beyond the grid, the way to it is added.
        """
        at = (points - self.low_m) / self.step_m
        inside = np.clip(at, 0.0, np.array(self.values.shape) - 1.0 - 1e-9)
        cell = inside.astype(np.int64)
        u, v, w = (inside - cell).T
        _, wide, deep = self.values.shape
        strides = np.array([wide * deep, deep, 1])
        # Corner values (2, 2, 2, N), then differences along one axis and means along the others.
        places = (_CORNERS @ strides)[:, None] + cell @ strides
        c = self.values.reshape(-1)[places].reshape(2, 2, 2, -1)
        along_x, at_x = c[1] - c[0], c[0] + u * (c[1] - c[0])
        along_y, at_xy = at_x[1] - at_x[0], at_x[0] + v * (at_x[1] - at_x[0])
        slope_x = along_x[0] + v * (along_x[1] - along_x[0])
        out = np.stack(
            [
                slope_x[0] + w * (slope_x[1] - slope_x[0]),
                along_y[0] + w * (along_y[1] - along_y[0]),
                at_xy[1] - at_xy[0],
            ],
            axis=1,
        )
        beyond = (at - inside) * self.step_m
        further = np.sqrt((beyond * beyond).sum(axis=1))
        out = np.where(further[:, None] > 1e-6, beyond, out)
        out /= np.maximum(np.sqrt((out * out).sum(axis=1)), 1e-12)[:, None]
        distances: FloatArray = at_xy[0] + w * (at_xy[1] - at_xy[0]) + further
        return distances, out


def distance_grid(corners: FloatArray, triangles: IntArray) -> DistanceGrid:
    """Return the signed distances from a surface; needs the extra `mesh`.

    What cannot be reached from outside of the grid without crossing the surface is inside. A surface that is not closed
    has no inside; fingers meet it as a sheet.

    Args:
        corners: (N, 3) metres.
        triangles: (M, 3) indices of corners, counter-clockwise from outside.
    """
    from scipy.ndimage import label  # noqa: PLC0415  # only who reads a mesh needs scipy and trimesh
    from scipy.spatial import cKDTree  # noqa: PLC0415
    from trimesh.remesh import subdivide_to_size  # noqa: PLC0415

    low, high = corners.min(axis=0), corners.max(axis=0)
    step = max(float((high - low).max()) / _NODES, _LEAST_STEP_M)
    axes = [np.arange(low[k] - _MARGIN * step, high[k] + (_MARGIN + 1) * step, step) for k in range(3)]
    nodes = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1)
    # Dense samples of the surface: the middle of every small triangle, with its normal.
    split: Callable[..., tuple[FloatArray, IntArray]] = subdivide_to_size
    fine, faces = split(corners, triangles, max_edge=0.7 * step, max_iter=20)
    a, b, c = (fine[faces[:, k]] for k in range(3))
    normals = np.cross(b - a, c - a)
    area = np.sqrt((normals * normals).sum(axis=1))
    kept = area > 1e-12
    normals, middles = normals[kept] / area[kept, None], ((a + b + c) / 3.0)[kept]
    far, nearest = cKDTree(middles).query(nodes.reshape(-1, 3), workers=1)
    above = ((nodes.reshape(-1, 3) - middles[nearest]) * normals[nearest]).sum(axis=1)
    aside = np.sqrt(np.maximum(far * far - above * above, 0.0))
    # Over the middle of a small triangle the plane tells the distance better than its sample.
    distance = np.where(aside < 0.7 * step, np.abs(above), far).reshape(nodes.shape[:3])
    free, _ = label(distance > step)
    outside = free == free[0, 0, 0]
    shell = free == 0
    sign = np.where(outside | (shell & (above.reshape(distance.shape) >= 0.0)), 1.0, -1.0)
    values = sign * distance
    values.setflags(write=False)
    return DistanceGrid(np.array([axis[0] for axis in axes]), step, values)
