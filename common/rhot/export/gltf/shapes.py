"""Triangles of what is drawn: bones, boxes, cylinders and balls, in metres."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from rhot.arrays import FloatArray
from rhot.geometry.hull import hull_surface
from rhot.messages.objects import BoxShape, CylinderShape, MeshShape, ObjectShape, SphereShape

_ROUND: Final = 24
"""Corners of a circle."""
_RINGS: Final = 12
_UNKNOWN_M: Final = 0.03
"""Edge of the cube that stands for a thing whose shape is not known."""


@dataclass(frozen=True, slots=True)
class Mesh:
    """A surface.

    Attributes:
        corners: (N, 3) metres.
        triangles: (M, 3) indices of corners, counter-clockwise from outside.
    """

    corners: FloatArray
    triangles: NDArray[np.int64]


def octahedron(middle: FloatArray, radius_m: float) -> Mesh:
    """Return an octahedron about a joint at `middle` (3,), metres."""
    corners = middle + radius_m * np.concatenate([np.eye(3), -np.eye(3)])
    faces = [(0, 1, 2), (1, 3, 2), (3, 4, 2), (4, 0, 2), (1, 0, 5), (3, 1, 5), (4, 3, 5), (0, 4, 5)]
    return Mesh(corners, np.array(faces))


def bone(start: FloatArray, end: FloatArray, radius_m: float) -> Mesh:
    """Return a pointed body from a joint (3,) to its child (3,), metres, widest near the start."""
    along = end - start
    length = float(np.linalg.norm(along))
    axis = along / length if length > 0.0 else np.array([0.0, 0.0, 1.0])
    first = np.cross(axis, np.eye(3)[int(np.abs(axis).argmin())])
    first /= np.linalg.norm(first)
    second = np.cross(axis, first)
    ring = start + 0.2 * along + radius_m * np.stack([first, second, -first, -second])
    corners = np.concatenate([ring, start[None], end[None]])
    sides = [face for k in range(4) for face in ((4, (k + 1) % 4, k), (5, k, (k + 1) % 4))]
    return Mesh(corners, np.array(sides))


def joined(meshes: list[Mesh]) -> Mesh:
    """Return several surfaces as one."""
    starts = np.cumsum([0, *(len(mesh.corners) for mesh in meshes)])
    triangles = [mesh.triangles + start for mesh, start in zip(meshes, starts, strict=False)]
    return Mesh(np.concatenate([mesh.corners for mesh in meshes]), np.concatenate(triangles))


def mesh_of(shape: ObjectShape | None) -> Mesh:
    """Return the surface of an object around its middle; a small cube where the shape is not known."""
    match shape:
        case BoxShape():
            return box(np.array(shape.size))
        case CylinderShape():
            return _cylinder(shape.radius, shape.height)
        case SphereShape():
            return _sphere(shape.radius)
        case MeshShape():
            corners, triangles = hull_surface(np.array(shape.planes))
            # Planes of a stranger need not close.
            return Mesh(corners, triangles) if len(triangles) else box(np.array(shape.size))
        case _:
            return box(np.full(3, _UNKNOWN_M))


def box(size_m: FloatArray) -> Mesh:
    """Return a cuboid of edges (3,) around the origin."""
    signs = np.array([(x, y, z) for x in (-1.0, 1.0) for y in (-1.0, 1.0) for z in (-1.0, 1.0)])
    quads = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)]
    faces = [face for a, b, c, d in quads for face in ((a, b, c), (a, c, d))]
    return Mesh(0.5 * signs * size_m, np.array(faces))


def _cylinder(radius_m: float, height_m: float) -> Mesh:
    angle = 2.0 * np.pi * np.arange(_ROUND) / _ROUND
    ring = radius_m * np.column_stack([np.cos(angle), np.sin(angle), np.zeros(_ROUND)])
    up = np.array([0.0, 0.0, 0.5 * height_m])
    corners = np.concatenate([ring - up, ring + up, [-up, up]])
    low, high = 2 * _ROUND, 2 * _ROUND + 1
    faces = []
    for k in range(_ROUND):
        n = (k + 1) % _ROUND
        faces += [(k, n, _ROUND + n), (k, _ROUND + n, _ROUND + k), (low, n, k), (high, _ROUND + k, _ROUND + n)]
    return Mesh(corners, np.array(faces))


def _sphere(radius_m: float) -> Mesh:
    polar = np.pi * np.arange(1, _RINGS) / _RINGS
    angle = 2.0 * np.pi * np.arange(_ROUND) / _ROUND
    rings = [(np.sin(p) * np.cos(a), np.sin(p) * np.sin(a), np.cos(p)) for p in polar for a in angle]
    corners = radius_m * np.array([*rings, (0.0, 0.0, 1.0), (0.0, 0.0, -1.0)])
    top, bottom = len(rings), len(rings) + 1
    last = (_RINGS - 2) * _ROUND
    faces = []
    for k in range(_ROUND):
        n = (k + 1) % _ROUND
        faces += [(top, k, n), (bottom, last + n, last + k)]
        for start in range(0, last, _ROUND):
            a, b, c, d = start + k, start + n, start + _ROUND + n, start + _ROUND + k
            faces += [(a, d, c), (a, c, b)]
    return Mesh(corners, np.array(faces))
