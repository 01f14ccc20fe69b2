"""Copies of a unit mesh: the one form in which moving things reach the browser, a few arrays a frame.

A ball is a unit sphere, a rod a unit cylinder along z (radius 1, from z = −0.5 to 0.5), a box a unit cube. Each copy
has its own position, rotation, stretch and colour.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import ArrayLike, NDArray

from rhot.arrays import FloatArray

Rgb = tuple[int, int, int]

_SCALE_STEP_M: Final = 1e-5
"""Sizes are rounded to this, so that a bone's length that only trembles in its last digits is not sent again."""


@dataclass(frozen=True, slots=True)
class Mesh:
    """A unit mesh.

    Attributes:
        vertices: (V, 3) float32.
        faces: (F, 3) uint32, counter-clockwise seen from outside.
    """

    vertices: NDArray[np.float32]
    faces: NDArray[np.uint32]


@dataclass(frozen=True, slots=True)
class Instances:
    """N copies of a unit mesh, rig frame.

    Attributes:
        positions: (N, 3) metres.
        wxyzs: (N, 4) unit quaternions, w first as the browser wants them.
        scales: (N, 3) metres, along the mesh's own axes.
        colors: (N, 3) red, green, blue.
    """

    positions: NDArray[np.float32]
    wxyzs: NDArray[np.float32]
    scales: NDArray[np.float32]
    colors: NDArray[np.uint8]

    def __len__(self) -> int:
        return len(self.positions)


def instances(positions: ArrayLike, wxyzs: ArrayLike, scales: ArrayLike, colors: ArrayLike) -> Instances:
    """Return copies of a mesh from arrays of the shapes in `Instances`; one row of `wxyzs` stands for all."""
    positions_f32 = np.asarray(positions, dtype=np.float32).reshape(-1, 3)
    rotations = np.broadcast_to(np.asarray(wxyzs, dtype=np.float32), (len(positions_f32), 4))
    sizes = np.asarray(scales, dtype=np.float64).reshape(-1, 3)
    rounded = (np.round(sizes / _SCALE_STEP_M) * _SCALE_STEP_M).astype(np.float32)
    return Instances(positions_f32, rotations, rounded, np.asarray(colors, dtype=np.uint8).reshape(-1, 3))


def balls(centers: FloatArray, radii: FloatArray, colors: ArrayLike) -> Instances:
    """Return balls of centres (N, 3) and radii (N,), metres, and colours (N, 3)."""
    return instances(centers, (1.0, 0.0, 0.0, 0.0), np.repeat(radii[:, None], 3, axis=1), colors)


def rods(starts: FloatArray, ends: FloatArray, radii: FloatArray, colors: ArrayLike) -> Instances:
    """Return rods between points (N, 3), of radii (N,), metres, and colours (N, 3)."""
    along = ends - starts
    lengths = np.linalg.norm(along, axis=1)
    scales = np.stack([radii, radii, lengths], axis=1)
    return instances(0.5 * (starts + ends), rotation_of_z(along), scales, colors)


def rotation_of_z(directions: FloatArray) -> FloatArray:
    """Return quaternions (N, 4), w first, that rotate +z into directions (N, 3) of any length; none for length 0.

    The half-way quaternion (1 + z·d, z × d), normalised; where d is −z, half a turn about x.
    """
    lengths = np.linalg.norm(directions, axis=1, keepdims=True)
    unit = np.where(lengths > 1e-9, directions / np.maximum(lengths, 1e-9), (0.0, 0.0, 1.0))
    wxyz = np.zeros((len(unit), 4))
    wxyz[:, 0] = 1.0 + unit[:, 2]
    wxyz[:, 1], wxyz[:, 2] = -unit[:, 1], unit[:, 0]
    wxyz[wxyz[:, 0] < 1e-6] = 0.0, 1.0, 0.0, 0.0
    rotated: FloatArray = wxyz / np.linalg.norm(wxyz, axis=1, keepdims=True)
    return rotated


def unit_ball(rings: int = 8, sectors: int = 14) -> Mesh:
    """Return a sphere of radius 1 about the origin."""
    polar = np.pi * np.arange(1, rings) / rings
    around = 2.0 * np.pi * np.arange(sectors) / sectors
    body = np.stack(
        [
            np.outer(np.sin(polar), np.cos(around)),
            np.outer(np.sin(polar), np.sin(around)),
            np.repeat(np.cos(polar)[:, None], sectors, axis=1),
        ],
        axis=-1,
    ).reshape(-1, 3)
    vertices = np.vstack([[0.0, 0.0, 1.0], body, [0.0, 0.0, -1.0]])
    faces: list[tuple[int, int, int]] = []
    last = len(vertices) - 1
    for sector in range(sectors):
        after = (sector + 1) % sectors
        faces.append((0, 1 + sector, 1 + after))
        for ring in range(rings - 2):
            low, high = 1 + ring * sectors, 1 + (ring + 1) * sectors
            faces += [(low + sector, high + sector, high + after), (low + sector, high + after, low + after)]
        bottom = last - sectors
        faces.append((last, bottom + after, bottom + sector))
    return _mesh(vertices, faces)


def unit_rod(sectors: int = 14) -> Mesh:
    """Return an open cylinder of radius 1 along z from −0.5 to 0.5; balls close its ends."""
    around = 2.0 * np.pi * np.arange(sectors) / sectors
    rim = np.stack([np.cos(around), np.sin(around)], axis=1)
    vertices = np.vstack([np.column_stack([rim, np.full(sectors, z)]) for z in (-0.5, 0.5)])
    faces = []
    for sector in range(sectors):
        after = (sector + 1) % sectors
        faces += [(sector, after, sectors + after), (sector, sectors + after, sectors + sector)]
    return _mesh(vertices, faces)


def unit_box() -> Mesh:
    """Return a cube of side 1 about the origin; each face has its own corners, so that its edges stay sharp."""
    vertices: list[FloatArray] = []
    faces: list[tuple[int, int, int]] = []
    for axis in range(3):
        for sign in (-0.5, 0.5):
            right, up = np.eye(3)[(axis + 1) % 3], np.eye(3)[(axis + 2) % 3]
            middle = sign * np.eye(3)[axis]
            first = len(vertices)
            vertices += [middle + 0.5 * (a * right + b * up) for a, b in ((-1, -1), (1, -1), (1, 1), (-1, 1))]
            quad = (0, 1, 2, 3) if sign > 0 else (3, 2, 1, 0)
            a, b, c, d = (first + corner for corner in quad)
            faces += [(a, b, c), (a, c, d)]
    return _mesh(np.array(vertices), faces)


def _mesh(vertices: FloatArray, faces: list[tuple[int, int, int]]) -> Mesh:
    return Mesh(vertices.astype(np.float32), np.array(faces, dtype=np.uint32))
