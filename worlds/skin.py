"""The skin of a hand: one closed mesh by surface nets over a smooth union of tapered capsules, weighted to the bones.

Rest pose: all angles zero, hand frame, millimetres. The forearm is one more bone after `BONES`; at rest its frame is
the hand frame with y towards the elbow reversed, so it is the identity as well.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import partial, reduce
from itertools import pairwise
from typing import Final

import numpy as np

from rhot.arrays import FloatArray
from worlds.hand import (
    BONES,
    FINGERS,
    MARKERS,
    Hand,
    bone_poses,
    cone_distance,
    rotation_xyz,
)

# The zero surface of a field on a grid.


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


FOREARM: Final = len(BONES)
FOREARM_MM: Final = 420.0
_CELL_MM: Final = 1.5
_SMOOTHINGS: Final = 5
_ONLY_ARM_MM: Final = 95.0
_ARM_END_MM: Final = 0.95 * FOREARM_MM


@dataclass(frozen=True, slots=True)
class Skin:
    """A mesh at rest with its weights.

    Attributes:
        vertices: (V, 3) mm, hand frame.
        quads: (F, 4) vertex indices, counter-clockwise from outside.
        weights: (V, 17) of `BONES` and the forearm; rows sum to 1.
        beyond: (V,) mm by which a vertex of a distal bone lies beyond its paint border; far below 0 elsewhere.
        finger: (F,) index into `MARKERS` of the finger whose paint may cover the face.
        width_mm: across the knuckles, as a ruler measures it.
    """

    vertices: FloatArray
    quads: np.ndarray
    weights: FloatArray
    beyond: FloatArray
    finger: np.ndarray
    width_mm: float


def with_patch(hand: Hand, rng: np.random.Generator) -> Hand:
    """Return the hand with its patch laid on the back of the hand, a little off centre, turned and tilted."""
    knuckle = hand.length_mm / 172.0
    x = 2.0 * knuckle + rng.uniform(-4.0, 4.0)
    y = 0.5 * float(hand.mcp["middle"][1]) + rng.uniform(-10.0, 4.0)
    turn = rotation_xyz(np.array([rng.uniform(-5, 5), rng.uniform(-5, 5), rng.uniform(-12, 12)]))
    across, along, thick = hand.patch
    u, v = np.meshgrid(np.linspace(-across / 2, across / 2, 15), np.linspace(-along / 2, along / 2, 11))
    below = np.stack([u, v, np.full_like(u, thick / 2)], -1).reshape(-1, 3) @ turn.T + np.array([x, y, 0.0])
    field = _Field(hand)
    # The plate comes down from above until it touches the highest point of the skin.
    heights = np.arange(-50.0, 0.0, 0.25)
    lowest = [float(field(below + np.array([0.0, 0.0, z])).min()) for z in heights]
    touching = float(heights[int(np.argmax(np.array(lowest) <= 0.15))])
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = turn, (x, y, touching)
    return replace(hand, T_hand_patch=pose)


def make_skin(hand: Hand) -> Skin:
    """Return the skin of a hand at rest."""
    field = _Field(hand)
    low, high = field.bounds()
    axes = [np.arange(low[i], high[i] + _CELL_MM, _CELL_MM) for i in range(3)]
    axes[1] = np.concatenate([np.arange(low[1], -_ONLY_ARM_MM, 4.0 * _CELL_MM), axes[1][axes[1] >= -_ONLY_ARM_MM]])
    values = np.empty(tuple(len(axis) for axis in axes))
    # Far behind the wrist there is but the arm.
    split = int(np.searchsorted(axes[1], -_ONLY_ARM_MM))
    for i, x in enumerate(axes[0]):
        for rows, part in ((slice(split), field.forearm), (slice(split, None), field)):
            points = np.stack(np.meshgrid([x], axes[1][rows], axes[2], indexing="ij"), -1)
            values[i, rows] = part(points.reshape(-1, 3)).reshape(points.shape[1:3])
    vertices, quads = surface_nets(values, axes)
    for _ in range(3):
        vertices = vertices - field(vertices)[:, None] * field.gradient(vertices)
    weights = field.weights(vertices)
    beyond, owner = _beyond_border(hand, field, vertices, weights)
    weights = _smoothed(weights, quads, beyond < -1.0)
    finger = owner[quads].max(axis=1)
    return Skin(vertices, quads, weights, beyond, finger, _ruler_width(hand, vertices, weights))


class _Field:
    """Signed distance to the hand at rest, and which bones a point belongs to."""

    def __init__(self, hand: Hand) -> None:
        rest = bone_poses(hand, np.zeros((1, 20)))[0]
        size = hand.length_mm / 172.0
        self.hand, self.rest, self.size = hand, rest, size
        self.chains = {}
        for name in MARKERS[:5]:
            self.chains[name] = [
                (cone.bone, *(rest[cone.bone] @ np.append(p, 1.0) for p in (cone.start, cone.end)), cone)
                for cone in hand.finger_cones(name)
            ]
        self.palm = self._palm(hand, size)
        self.wrist_mm = 15.5 * size
        self.elbow = np.array([-4.0, -FOREARM_MM, 4.0])

    @staticmethod
    def _palm(hand: Hand, size: float) -> list[tuple[FloatArray, FloatArray, float, float]]:
        bases = {
            "index": (12.0, 10.0, 0.0),
            "middle": (3.0, 9.0, -2.0),
            "ring": (-6.0, 9.0, -1.0),
            "little": (-13.0, 10.0, 2.0),
        }
        cones = []
        for finger in FINGERS:
            knuckle = hand.mcp[finger]
            base = size * np.array(bases[finger])
            radius = hand.radii[finger][0]
            under = knuckle + np.array([0.0, -2.0, 3.0 * size])
            cones.append((base, under, 11.5 * size, radius + 1.5 * size))
            # Knuckle and tendon stand out on the back of the hand.
            tendon, top = base + size * np.array([0.0, 20.0, -8.0]), knuckle + np.array([0.0, -1.0, -0.5 * size])
            cones.append((tendon, top, 2.0, radius + 0.3 * size))
        behind = size * np.array([0.0, -9.0, 3.0])
        for first, second in pairwise(hand.mcp[finger] + behind for finger in FINGERS):
            cones.append((first, second, 10.0 * size, 9.5 * size))
        heel, edge = size * np.array([-10.0, 12.0, 6.0]), hand.mcp["little"] + np.array([0.0, -12.0, 5.0])
        cones.append((heel, edge, 13.0 * size, 9.0 * size))
        return cones

    def bounds(self) -> tuple[FloatArray, FloatArray]:
        tips = np.array([item[2][:3] for chain in self.chains.values() for item in chain])
        low = np.minimum(tips.min(0), [-40 * self.size, 0, -28]) - 16.0
        high = np.maximum(tips.max(0), [45 * self.size, 0, 30]) + 16.0
        low[:2] = min(low[0], -50.0 * self.size), -_ARM_END_MM - 4.0
        high[0] = max(high[0], 50.0 * self.size)
        return low, high

    def parts(self, points: FloatArray) -> tuple[dict[str, FloatArray], FloatArray, FloatArray]:
        chains = {}
        for name, chain in self.chains.items():
            bones = [cone_distance(points, a[:3], b[:3], cone.start_mm, cone.end_mm) for _, a, b, cone in chain]
            chains[name] = reduce(partial(_smooth_min, k=2.0), bones)
        palm = reduce(
            partial(_smooth_min, k=5.0 * self.size),
            [cone_distance(points, start, end, a, b) for start, end, a, b in self.palm],
        )
        return chains, palm, self._arm(points)

    def _arm(self, points: FloatArray) -> FloatArray:
        flat = points * np.array([1.0, 1.0, 1.28])
        arm = cone_distance(flat, np.array([0.0, 0.0, 1.0]), self.elbow, 1.5 * self.wrist_mm, 2.6 * self.wrist_mm)
        return arm * 0.9

    def forearm(self, points: FloatArray) -> FloatArray:
        """Return the field far behind the wrist."""
        return np.maximum(self._arm(points), -(points[:, 1] + _ARM_END_MM))

    def __call__(self, points: FloatArray) -> FloatArray:
        chains, palm, arm = self.parts(points)
        body = _smooth_min(palm, arm, 12.0 * self.size)
        whole = _smooth_min(body, chains["thumb"], 9.0 * self.size)
        for finger in FINGERS:
            whole = np.minimum(whole, _smooth_min(body, chains[finger], 5.0 * self.size))
        return np.maximum(whole, -(points[:, 1] + _ARM_END_MM))

    def gradient(self, points: FloatArray) -> FloatArray:
        step = 0.2
        out = np.stack([self(points + step * e) - self(points - step * e) for e in np.eye(3)], -1) / (2 * step)
        return np.asarray(out / np.maximum(np.linalg.norm(out, axis=1, keepdims=True), 0.3) ** 2)

    def weights(self, points: FloatArray) -> FloatArray:
        chains, palm, _ = self.parts(points)
        hand, size = self.hand, self.size
        names = list(chains)
        nearest = np.argmin(np.stack([chains[n] for n in names]), axis=0)
        out = np.zeros((len(points), len(BONES) + 1))
        arm = _ramp(-points[:, 1], 2.0 * size, 30.0 * size)
        for place, name in enumerate(names):
            mine = nearest == place
            local = [
                (points[mine] - self.rest[bone][:3, 3]) @ self.rest[bone][:3, :3] for bone, *_ in self.chains[name]
            ]
            r = hand.radii[name]
            # Share that has passed each joint of the chain, along the bone axis.
            zone = min(0.55 * r[2], 0.8 * hand.border(name))
            if name == "thumb":
                near = chains[name][mine] - palm[mine]
                past0 = _ramp(local[0][:, 1], -0.1 * hand.lengths[name][0], 0.75 * hand.lengths[name][0]) * _ramp(
                    -near, -8.0 * size, 4.0 * size
                )
            else:
                past0 = _ramp(local[0][:, 1], -0.75 * r[0], 0.9 * r[0])
            past1 = _ramp(local[1][:, 1], -0.55 * r[1], 0.55 * r[1])
            past2 = _ramp(local[2][:, 1], -zone, zone)
            a, b, c = (bone for bone, *_ in self.chains[name])
            past0 = np.maximum(past0, past1)
            past1 = np.maximum(past1, past2)
            rows = out[mine]
            rows[:, a], rows[:, b], rows[:, c] = past0 - past1, past1 - past2, past2
            rows[:, 0] = 1.0 - past0
            out[mine] = rows
        share = arm * out[:, 0]
        out[:, FOREARM] = share
        out[:, 0] -= share
        return out


def _smoothed(weights: FloatArray, quads: np.ndarray, free: np.ndarray) -> FloatArray:
    """Return weights averaged with their neighbours', so that webs do not tear; those of painted skin stay."""
    pairs = np.concatenate([quads[:, [i, (i + 1) % 4]] for i in range(4)])
    count = np.bincount(pairs[:, 0], minlength=len(weights))[:, None]
    for _ in range(_SMOOTHINGS):
        total = np.stack([np.bincount(pairs[:, 0], w[pairs[:, 1]], len(weights)) for w in weights.T], axis=1)
        weights = np.where(free[:, None], 0.5 * weights + 0.5 * total / np.maximum(count, 1), weights)
    return np.asarray(weights / weights.sum(axis=1, keepdims=True))


def _beyond_border(hand: Hand, field: _Field, points: FloatArray, weights: FloatArray) -> tuple[FloatArray, np.ndarray]:
    beyond, owner = np.full(len(points), -50.0), np.full(len(points), -1)
    for place, name in enumerate(MARKERS[:5]):
        bone = BONES.index(f"{name}_distal")
        middle = BONES.index(f"{name}_{'proximal' if name == 'thumb' else 'middle'}")
        mine = weights[:, bone] + weights[:, middle] > 0.6
        local = (points[mine] - field.rest[bone][:3, 3]) @ field.rest[bone][:3, 1]
        beyond[mine], owner[mine] = local - hand.border(name), place
    return beyond, owner


def _ruler_width(hand: Hand, points: FloatArray, weights: FloatArray) -> float:
    """Return the extent of palm and fingers along the line of knuckles, thumb left out."""
    line = hand.mcp["index"] - hand.mcp["little"]
    line[2] = 0.0
    line /= np.linalg.norm(line)
    across = np.array([-line[1], line[0], 0.0])
    off = (points - hand.mcp["little"]) @ across
    thumb = weights[:, 1:4].sum(axis=1)
    near = (np.abs(off) < 5.0) & (thumb < 0.02)
    at = points[near] @ line
    return float(at.max() - at.min())


def _smooth_min(a: FloatArray, b: FloatArray, k: float) -> FloatArray:
    """Return the smaller of two distances with a fillet of size k (Quilez, polynomial smooth minimum)."""
    h = np.clip(0.5 + 0.5 * (b - a) / k, 0.0, 1.0)
    return b + (a - b) * h - k * h * (1.0 - h)


def _ramp(x: FloatArray, low: float, high: float) -> FloatArray:
    t = np.clip((x - low) / (high - low), 0.0, 1.0)
    return t * t * (3.0 - 2.0 * t)
