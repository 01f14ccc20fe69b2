"""Distances between fingers, palm, desk and a grasped object, by which impossible motions are rejected."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Final

import numpy as np

from rhot.arrays import FloatArray
from worlds.hand import FINGERS, MARKERS, Hand, cone_distance
from worlds.motion import States
from worlds.skin import surface_nets

_SAMPLES: Final = 5


@dataclass(frozen=True, slots=True)
class Solid:
    """An object on the desk, its centre the origin, z up.

    Attributes:
        kind: `cylinder`, `box`, `ball`, `ring` (upright, its hole along y) or `handle` (a bar along x on two posts).
        half: half extents (x, y, z), mm; of a cylinder and a ball x is the radius, of a ring and a handle y is that of
            the bar.
    """

    kind: str
    half: FloatArray

    @property
    def barred(self) -> bool:
        """Whether fingers close round a bar of it rather than round the whole."""
        return self.kind in {"ring", "handle"}

    def distance(self, points: FloatArray) -> FloatArray:
        """Return the signed distance of (..., 3) points in the object's frame."""
        if self.kind == "ball":
            return np.asarray(np.linalg.norm(points, axis=-1) - self.half[0])
        if self.kind == "ring":
            bar = self.half[1]
            round_mm = np.linalg.norm(points[..., [0, 2]], axis=-1) - (self.half[0] - bar)
            return np.asarray(np.hypot(round_mm, points[..., 1]) - bar)
        if self.kind == "handle":
            x, bar = self.half[0] - self.half[1], self.half[1]
            top, foot = self.half[2] - bar, bar - self.half[2]
            ends = [((-x, 0, top), (x, 0, top)), ((-x, 0, foot), (-x, 0, top)), ((x, 0, foot), (x, 0, top))]
            return np.asarray(
                np.min(
                    [cone_distance(points, np.array(a, float), np.array(b, float), bar, bar) for a, b in ends], axis=0
                )
            )
        if self.kind == "cylinder":
            over = np.stack(
                [np.linalg.norm(points[..., :2], axis=-1) - self.half[0], np.abs(points[..., 2]) - self.half[2]], -1
            )
        else:
            over = np.abs(points) - self.half
        return np.asarray(np.linalg.norm(np.maximum(over, 0.0), axis=-1) + np.minimum(over.max(axis=-1), 0.0))

    def surface(self) -> tuple[FloatArray, np.ndarray]:
        """Return its surface: corners (V, 3), mm, and quads (F, 4)."""
        axes = [np.arange(-reach - 4.0, reach + 4.0, 1.0) for reach in self.half]
        return surface_nets(self.distance(np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1)), axes)

    def to_json(self) -> dict[str, Any]:
        """Return the object in the form of `hand.json`."""
        about = {"axis": "local z (centre = origin)", "pose": "obj_* columns of G2/truth_500hz.csv.gz"}
        if self.kind == "ball":
            return {"type": "ball", "radius_mm": round(float(self.half[0]), 3), **about}
        if self.kind == "cylinder":
            size = {"radius_mm": round(float(self.half[0]), 3), "height_mm": round(float(2 * self.half[2]), 3)}
            return {"type": "upright cylinder", **size, "edge_radius_mm": EDGE_MM, **about}
        if self.barred:
            size = {"size_mm": np.round(2 * self.half, 3).tolist(), "bar_radius_mm": round(float(self.half[1]), 3)}
            return {"type": self.kind, **size, **about}
        return {
            "type": "upright box",
            "size_mm": np.round(2 * self.half, 3).tolist(),
            "edge_radius_mm": EDGE_MM,
            **about,
        }


EDGE_MM: Final = 2.0
"""Radius of the object's rounded edges in the picture; `distance` takes them as sharp."""


def finger_points(hand: Hand, bones: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return points along the axes of the fingers and their radii.

    Args:
        hand: its cones.
        bones: (N, 16, 4, 4).

    Returns:
        points (N, 5, 15, 3) by marker, proximal first, and radii (5, 15); mm.
    """
    points, radii = [], []
    share = np.linspace(0.0, 1.0, _SAMPLES)
    for name in MARKERS[:5]:
        mine, thick = [], []
        for cone in hand.finger_cones(name):
            local = cone.start + share[:, None] * (cone.end - cone.start)
            pose = bones[:, cone.bone]
            mine.append(np.einsum("nij,kj->nki", pose[:, :3, :3], local) + pose[:, None, :3, 3])
            thick.append(cone.start_mm + share * (cone.end_mm - cone.start_mm))
        points.append(np.concatenate(mine, axis=1))
        radii.append(np.concatenate(thick))
    return np.stack(points, axis=1), np.stack(radii)


def least_gap(hand: Hand, motion: States) -> float:
    """Return the least distance between two fingers, or a tip and the palm, over a motion; negative = overlap, mm.

    Proximal phalanges of neighbours are left out: they lie side by side in every hand.
    """
    points, radii = finger_points(hand, motion.bones)
    least = np.inf
    for i in range(5):
        for j in range(i + 1, 5):
            first = _SAMPLES + 1 if i else _SAMPLES
            a, ra = points[:, i, first:], radii[i, first:]
            b, rb = points[:, j, _SAMPLES + 1 if i else 0 :], radii[j, _SAMPLES + 1 if i else 0 :]
            apart = np.linalg.norm(a[:, :, None] - b[:, None], axis=-1) - ra[:, None] - rb
            least = min(least, float(apart.min()))
    inverse = np.linalg.inv(motion.T_world_hand)
    tips = points[:, :, 2 * _SAMPLES + 1 :]
    local = np.einsum("nij,nfkj->nfki", inverse[:, :3, :3], tips) + inverse[:, None, None, :3, 3]
    palm = _palm_gap(hand, local[:, 1:]) - radii[1:, 2 * _SAMPLES + 1 :]
    return min(least, float(palm.min()))


def object_gap(hand: Hand, motion: States, solid: Solid, T_world_object: FloatArray) -> FloatArray:
    """Return (N, 6) least distances of thumb, fingers and palm to an object, mm."""
    points, radii = finger_points(hand, motion.bones)
    inverse = np.linalg.inv(np.broadcast_to(T_world_object, motion.T_world_hand.shape))
    local = np.einsum("nij,nfkj->nfki", inverse[:, :3, :3], points) + inverse[:, None, None, :3, 3]
    fingers = (solid.distance(local) - radii).min(axis=-1)
    palm = _palm_points(hand)
    at = np.einsum("nij,kj->nki", (inverse @ motion.T_world_hand)[:, :3, :3], palm[:, :3])
    at += (inverse @ motion.T_world_hand)[:, None, :3, 3]
    below = (solid.distance(at) - palm[:, 3]).min(axis=1)
    return np.concatenate([fingers, below[:, None]], axis=1)


def desk_gap(hand: Hand, motion: States) -> float:
    """Return the least height of a finger's skin over the desk, mm."""
    points, radii = finger_points(hand, motion.bones)
    return float((points[..., 2] - radii).min())


def _palm_points(hand: Hand) -> FloatArray:
    """Return (K, 4) spheres, centre and radius, that fill the palm and the ball of the thumb; hand frame."""
    size = hand.length_mm / 172.0
    rows = []
    for finger in FINGERS:
        for share in np.linspace(0.1, 1.0, 6):
            centre = share * hand.mcp[finger] + np.array([0.0, 0.0, 3.0 * size])
            rows.append([*centre, hand.radii[finger][0] + 2.5 * size])
    return np.array(rows)


def _palm_gap(hand: Hand, local: FloatArray) -> FloatArray:
    palm = _palm_points(hand)
    gaps = np.linalg.norm(local[..., None, :] - palm[:, :3], axis=-1) - palm[:, 3]
    return np.asarray(gaps.min(axis=-1))
