"""The zero surface of a field on a grid."""

from __future__ import annotations

import numpy as np

from rhot.arrays import FloatArray


def surface_nets(values: FloatArray, axes: list[FloatArray]) -> tuple[FloatArray, np.ndarray]:
    """Return vertices (V, 3) and quads (F, 4) of the zero surface of a field, negative inside, given on a grid.

    One vertex a cell that the surface crosses, at the mean of its edge crossings (Gibson, "Constrained elastic surface
    nets", 1998), and one quad for each grid edge that it crosses.
    """
    inside = values < 0.0
    shape = tuple(n - 1 for n in values.shape)
    total, hits = np.zeros((*shape, 3)), np.zeros(shape)
    for axis in range(3):
        for du in (0, 1):
            for dv in (0, 1):
                at = [du, dv]
                at.insert(axis, 0)
                first = tuple(slice(at[i], at[i] + shape[i]) for i in range(3))
                second = tuple(slice(at[i] + (i == axis), at[i] + (i == axis) + shape[i]) for i in range(3))
                a, b = values[first], values[second]
                crossing = inside[first] != inside[second]
                part = np.where(crossing, a / np.where(crossing, a - b, 1.0), 0.0)
                for i in range(3):
                    total[..., i] += crossing * (part if i == axis else at[i])
                hits += crossing
    used = hits > 0
    index = np.full(shape, -1)
    index[used] = np.arange(int(used.sum()))
    cells = np.argwhere(used)
    at_cell = cells + total[used] / hits[used][:, None]
    vertices = np.stack([np.interp(at_cell[:, i], np.arange(len(axes[i])), axes[i]) for i in range(3)], axis=1)
    quads = []
    for axis in range(3):
        u, v = [i for i in range(3) if i != axis]
        lower = np.take(inside, range(values.shape[axis] - 1), axis)
        upper = np.take(inside, range(1, values.shape[axis]), axis)
        edges = np.argwhere(lower != upper)
        edges = edges[(edges[:, u] > 0) & (edges[:, v] > 0)]
        edges = edges[(edges[:, u] < shape[u]) & (edges[:, v] < shape[v])]
        corners = []
        for du, dv in ((1, 1), (0, 1), (0, 0), (1, 0)):
            place = edges.copy()
            place[:, u] -= du
            place[:, v] -= dv
            corners.append(index[tuple(place.T)])
        quad = np.stack(corners, 1)
        outward = lower[tuple(edges.T)] ^ (axis == 1)
        quads.append(np.where(outward[:, None], quad, quad[:, ::-1]))
    return vertices, np.concatenate(quads)
