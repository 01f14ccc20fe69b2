"""Signed distances of points from the objects that fingers close around, and the outward normals there."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np

from rhot.arrays import FloatArray
from rhot.geometry.hull import plane_distance


class Shape(Protocol):
    """A solid body in the rig frame."""

    def distance(self, points: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return how far points (N, 3), metres, lie outside, (N,), negative inside, and the way out (N, 3), unit."""
        ...


@dataclass(frozen=True, slots=True)
class Sphere:
    """A ball.

    Attributes:
        centre: (3,) metres, rig frame.
        radius_m: its radius.
    """

    centre: FloatArray
    radius_m: float

    def distance(self, points: FloatArray) -> tuple[FloatArray, FloatArray]:
        """See `Shape`."""
        off = points - self.centre
        far = np.sqrt((off * off).sum(-1))
        return far - self.radius_m, off / np.maximum(far, 1e-9)[:, None]


@dataclass(frozen=True, slots=True)
class Box:
    """A cuboid.

    Attributes:
        T_rig_box: (4, 4) pose of its middle.
        size_m: (3,) its edges along its own x, y, z.
    """

    T_rig_box: FloatArray
    size_m: FloatArray

    def distance(self, points: FloatArray) -> tuple[FloatArray, FloatArray]:
        """See `Shape`."""
        R = self.T_rig_box[:3, :3]
        local = (points - self.T_rig_box[:3, 3]) @ R
        distance, out = _of_slabs(np.abs(local) - 0.5 * self.size_m)
        return distance, (out * np.where(local < 0.0, -1.0, 1.0)) @ R.T


@dataclass(frozen=True, slots=True)
class Cylinder:
    """A round body with flat ends.

    Attributes:
        T_rig_cylinder: (4, 4) pose of its middle; its own z is its axis.
        radius_m, height_m: its radius and its length along the axis.
    """

    T_rig_cylinder: FloatArray
    radius_m: float
    height_m: float

    def distance(self, points: FloatArray) -> tuple[FloatArray, FloatArray]:
        """See `Shape`."""
        R = self.T_rig_cylinder[:3, :3]
        local = (points - self.T_rig_cylinder[:3, 3]) @ R
        round_m = np.hypot(local[:, 0], local[:, 1])
        beyond = np.stack([round_m - self.radius_m, np.abs(local[:, 2]) - 0.5 * self.height_m], axis=1)
        distance, out = _of_slabs(beyond)
        axes = np.empty((len(points), 3))
        axes[:, :2] = out[:, :1] * local[:, :2] / np.maximum(round_m, 1e-9)[:, None]
        axes[:, 2] = out[:, 1] * np.where(local[:, 2] < 0.0, -1.0, 1.0)
        return distance, axes @ R.T


@dataclass(frozen=True, slots=True)
class Hull:
    """A convex body between planes, in place of a mesh.

    Attributes:
        T_rig_hull: (4, 4) pose of its middle.
        planes: (K, 4) unit normal that leads out and distance from the middle, metres.
    """

    T_rig_hull: FloatArray
    planes: FloatArray

    def distance(self, points: FloatArray) -> tuple[FloatArray, FloatArray]:
        """See `Shape`."""
        R = self.T_rig_hull[:3, :3]
        distance, out = plane_distance(self.planes, (points - self.T_rig_hull[:3, 3]) @ R)
        return distance, out @ R.T


def _of_slabs(beyond: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return distance (N,) and way out (N, k) of points that lie beyond the faces of k slabs by (N, k), metres."""
    outside = np.maximum(beyond, 0.0)
    far = np.sqrt((outside * outside).sum(-1))
    nearest = np.eye(beyond.shape[1])[np.argmax(beyond, axis=1)]
    inside = far == 0.0
    distance: FloatArray = np.where(inside, beyond.max(axis=1), far)
    return distance, np.where(inside[:, None], nearest, outside / np.maximum(far, 1e-12)[:, None])
