"""What a blob detector sees of painted caps and a patch: the middle of the paint that faces the camera unhidden.

A cap is a half ball on a cone, painted from the very tip backwards; its surface is a few dozen samples with normal and
area. A sample counts when it faces the camera and no capsule of another bone, of the palm or of the object in the hand
lies on its way to the camera. The centroid weighs each by its projected area. Motion blur is left out: the middle of a
blurred blob is that at mid-exposure but for e²/24 times the acceleration, 0.05 mm at 8 ms and 20 m/s².
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from rhot.anatomy.skeleton import FINGERS
from rhot.arrays import BoolArray, FloatArray, IntArray
from rhot_bench.motion.recordings import HandMotion, HandShape

# What was true of one rig before one clip: markers, joints, and what each camera could see, at any time.

MARKERS: Final = (*FINGERS, "base")
START_NS: Final = 1_000_000_000_000
"""Rig time at which every clip starts."""
WELL_SEEN: Final = 0.25
"""A camera counts as seeing a marker when this share of its facing paint is unhidden, as in `score.py`."""


@dataclass(frozen=True, slots=True)
class Truth:
    """What was true.

    Attributes:
        motion: the hand at any time.
        surfaces: painted surface of each marker of `MARKERS`, in a frame at the very tip or in the wrist frame.
        frame_t_ns: per camera (F,) mid-exposure of the middle row of every frame, lost ones included.
        visible: per camera (F, 6) whether the marker was a blob in that frame, lost ones included.
        whole: per camera (F, 6) share of the paint facing the camera that nothing hides.
    """

    motion: HandMotion
    surfaces: Sequence[Surface]
    frame_t_ns: tuple[IntArray, ...]
    visible: tuple[NDArray[np.bool_], ...]
    whole: tuple[FloatArray, ...]

    def seconds(self, t_ns: IntArray) -> FloatArray:
        """Return times (N,) as seconds of the clip."""
        return np.asarray(t_ns - START_NS, dtype=np.float64) * 1e-9

    def hand(self, t_ns: IntArray) -> HandShape:
        """Return the hand at times (N,)."""
        return self.motion.at(self.seconds(t_ns))

    def joints(self, t_ns: IntArray) -> FloatArray:
        """Return the 26 joints (N, 26, 3) of OpenXR at times (N,), metres, rig frame."""
        return self.hand(t_ns).joints

    def markers(self, t_ns: IntArray) -> FloatArray:
        """Return the middles (N, 6, 3) of paint and patch at times (N,), metres, rig frame."""
        hand = self.hand(t_ns)
        frames = [marker_frames_of(hand, number) for number in range(len(MARKERS))]
        markers: FloatArray = np.stack(
            [origin + R @ self.surfaces[k].centre for k, (origin, R) in enumerate(frames)], axis=1
        )
        return markers

    def bone_axes(self, t_ns: IntArray) -> FloatArray:
        """Return unit directions (N, 6, 3): of each outermost bone, for the patch from the wrist to the fingers."""
        hand = self.hand(t_ns)
        return np.stack([-marker_frames_of(hand, number)[1][:, :, 2] for number in range(len(MARKERS))], axis=1)

    def views(self, t_ns: IntArray, least: float = WELL_SEEN) -> IntArray:
        """Return how many cameras see each marker (N, 6) at times (N,): in the frame nearest in time, lost or not.

        Args:
            t_ns: times.
            least: share of the facing paint that must be unhidden; 0 = any blob counts.
        """
        count = np.zeros((len(t_ns), len(MARKERS)), dtype=np.int64)
        for times, visible, whole in zip(self.frame_t_ns, self.visible, self.whole, strict=True):
            nearest = _nearest(times, t_ns)
            count += visible[nearest] & (whole[nearest] >= least)
        return count

    def hidden_s(self, t_ns: IntArray) -> FloatArray:
        """Return for how long each marker (N, 6) has been hidden from all cameras.

        0 while a camera sees any of it, NaN before it was first seen.
        """
        hidden = np.full((len(t_ns), len(MARKERS)), np.nan)
        for marker in range(len(MARKERS)):
            last = np.sort(
                np.concatenate([t[v[:, marker]] for t, v in zip(self.frame_t_ns, self.visible, strict=True)])
            )
            if not len(last):
                continue
            place = np.searchsorted(last, t_ns, side="right") - 1
            after = (t_ns - last[np.maximum(place, 0)]) * 1e-9
            hidden[:, marker] = np.where(place >= 0, after, np.nan)
        return np.where(self.views(t_ns, 0.0) > 0, 0.0, hidden)


def marker_frames_of(hand: HandShape, number: int) -> tuple[FloatArray, FloatArray]:
    """Return origins (N, 3) and axes (N, 3, 3) of a marker's own frame: at the very tip, or the wrist frame."""
    if number == len(FINGERS):
        return hand.wrist, hand.R
    tip = hand.chain[:, number, 3]
    Z = hand.chain[:, number, 2] - tip
    Z /= np.linalg.norm(Z, axis=1, keepdims=True)
    X = hand.R[:, :, 0] - Z * (hand.R[:, :, 0] * Z).sum(axis=1, keepdims=True)
    X /= np.linalg.norm(X, axis=1, keepdims=True)
    return tip, np.stack([X, np.cross(Z, X), Z], axis=-1)


def _nearest(times: IntArray, wanted: IntArray) -> IntArray:
    after = np.clip(np.searchsorted(times, wanted), 1, max(len(times) - 1, 1))
    nearer = wanted - times[after - 1] < times[np.minimum(after, len(times) - 1)] - wanted
    found: IntArray = np.where(nearer, after - 1, np.minimum(after, len(times) - 1))
    return found


_AROUND: Final = 10
_BALL: Final = 4
_CONE: Final = 3
_LIFT_M: Final = 0.0015
"""Rays start this far off the skin, so that neighbouring bones that meet in a joint do not hide one another's skin."""


@dataclass(frozen=True, slots=True)
class Surface:
    """Samples of a painted surface in a frame of its own.

    Attributes:
        points: (S, 3) metres.
        normals: (S, 3) unit vectors.
        areas: (S,) m².
        centre: (3,) what the marker's truth is: the middle of the painted volume, or of the patch.
    """

    points: FloatArray
    normals: FloatArray
    areas: FloatArray
    centre: FloatArray


def cap_surface(length_m: float, tip_radius_m: float, rear_radius_m: float, bare_m: float = 0.0) -> Surface:
    """Return a painted cap; origin at the very tip, z backwards along the bone, axes of rotation alike.

    Args:
        length_m: painted, from the very tip.
        tip_radius_m: of the half ball.
        rear_radius_m: of the finger where the paint ends.
        bare_m: from the very tip without paint, less than the ball's radius.
    """
    around = (np.arange(_AROUND) + 0.5) * (2.0 * np.pi / _AROUND)
    ring = np.column_stack([np.cos(around), np.sin(around), np.zeros(_AROUND)])
    parts = []
    # Equal steps of height cut a ball into zones of equal area.
    heights = (np.arange(_BALL) + 0.5) / _BALL
    for height in heights[heights * tip_radius_m > tip_radius_m - length_m]:
        normal = np.sqrt(1.0 - height**2) * ring - [0.0, 0.0, height]
        area = np.full(_AROUND, 2.0 * np.pi * tip_radius_m**2 / _BALL / _AROUND)
        parts.append((normal * tip_radius_m + [0.0, 0.0, tip_radius_m], normal, area))
    straight = max(length_m - tip_radius_m, 0.0)
    slope = np.arctan2(rear_radius_m - tip_radius_m, max(straight, 1e-6))
    for share in (np.arange(_CONE) + 0.5) / _CONE if straight > 0.0 else ():
        radius = tip_radius_m + share * (rear_radius_m - tip_radius_m)
        normal = np.cos(slope) * ring - [0.0, 0.0, np.sin(slope)]
        area = np.full(_AROUND, 2.0 * np.pi * radius * straight / np.cos(slope) / _CONE / _AROUND)
        parts.append((radius * ring + [0.0, 0.0, tip_radius_m + share * straight], normal, area))
    points, normals, areas = (np.concatenate(column) for column in zip(*parts, strict=True))
    ball, mean = 2.0 / 3.0 * tip_radius_m**3, 0.5 * (tip_radius_m + rear_radius_m)
    cone = mean**2 * straight
    # A segment of the ball, and its volume times the distance from the tip, both over pi.
    bare = bare_m**2 * (tip_radius_m - bare_m / 3.0)
    bare_moment = bare_m**3 * (2.0 / 3.0 * tip_radius_m - 0.25 * bare_m)
    moment = ball * 0.625 * tip_radius_m + cone * (tip_radius_m + 0.5 * straight) - bare_moment
    behind = moment / (ball + cone - bare)
    shown = points[:, 2] > bare_m
    return Surface(points[shown], normals[shown], areas[shown], np.array([0.0, 0.0, behind]))


def patch_surface(size_m: tuple[float, float]) -> Surface:
    """Return a patch across x and along z, facing +y; origin at its middle."""
    columns, rows = 8, 6
    x = ((np.arange(columns) + 0.5) / columns - 0.5) * size_m[0]
    z = ((np.arange(rows) + 0.5) / rows - 0.5) * size_m[1]
    grid = np.stack(np.meshgrid(x, z, indexing="ij"), axis=-1).reshape(-1, 2)
    points = np.column_stack([grid[:, 0], np.zeros(len(grid)), grid[:, 1]])
    normals = np.tile([0.0, 1.0, 0.0], (len(grid), 1))
    return Surface(points, normals, np.full(len(grid), size_m[0] * size_m[1] / len(grid)), np.zeros(3))


@dataclass(frozen=True, slots=True)
class Capsules:
    """K capsules of N moments: all points within a radius of a segment.

    Attributes:
        begin, end: (N, K, 3) metres.
        radius: (K,) metres.
        finger: (K,) whose outermost bone it is; −1 = of none.
    """

    begin: FloatArray
    end: FloatArray
    radius: FloatArray
    finger: FloatArray


@dataclass(frozen=True, slots=True)
class Flesh:
    """How thick a hand is, and what it holds.

    Attributes:
        bones_m: (5, 3) radii of the moving bones.
        palm_m: (4,) radii of the metacarpals of the long fingers.
        object_middle: (3,) metres, wrist frame: middle of the object held; unused without one.
        object_axis: (3,) its axis from the middle to either end, metres, wrist frame.
        object_radius_m: 0 = nothing is held.
    """

    bones_m: FloatArray
    palm_m: FloatArray
    object_middle: FloatArray
    object_axis: FloatArray
    object_radius_m: float

    def capsules(self, hand: HandShape) -> Capsules:
        """Return all that can hide a marker."""
        count = len(hand.wrist)
        begin = [hand.chain[:, :, :3].reshape(count, 15, 3), np.repeat(hand.wrist[:, None], 4, axis=1)]
        # The outermost capsule ends one radius before the very tip.
        ends = hand.chain[:, :, 1:].copy()
        distal = ends[:, :, 2] - hand.chain[:, :, 2]
        size = np.linalg.norm(distal, axis=-1, keepdims=True)
        ends[:, :, 2] -= distal / size * np.minimum(self.bones_m[:, 2, None], 0.9 * size)
        end = [ends.reshape(count, 15, 3), hand.chain[:, 1:, 0]]
        radius = [self.bones_m.reshape(-1), self.palm_m]
        finger = [np.array([f if bone == 2 else -1 for f in range(5) for bone in range(3)]), np.full(4, -1)]
        if self.object_radius_m > 0.0:
            middle, axis = hand.wrist + hand.R @ self.object_middle, hand.R @ self.object_axis
            begin.append((middle - axis)[:, None])
            end.append((middle + axis)[:, None])
            radius.append(np.array([self.object_radius_m]))
            finger.append(np.array([-1]))
        return Capsules(
            np.concatenate(begin, axis=1),
            np.concatenate(end, axis=1),
            np.concatenate(radius),
            np.concatenate(finger).astype(np.float64),
        )


def seen_samples(
    points: FloatArray, normals: FloatArray, eye: FloatArray, capsules: Capsules, finger: int
) -> tuple[FloatArray, FloatArray]:
    """Return which samples of one marker a camera sees.

    Args:
        points: (N, S, 3) metres.
        normals: (N, S, 3).
        eye: (3,) the camera's centre.
        capsules: of the N moments.
        finger: that wears the marker, 0 to 4; −1 for the patch.

    Returns:
        (N, S) cosine to the camera of samples that face it, else 0; and the same with hidden samples 0.
    """
    away = eye - points
    distance = np.linalg.norm(away, axis=-1, keepdims=True)
    away /= distance
    cosine = np.einsum("nsi,nsi->ns", normals, away)
    # Least cosine to the camera: paint seen flatter than 5° is lost at the rim of the blob.
    cosine = np.where(cosine > 0.08, cosine, 0.0)
    # The patch lies on the metacarpals: they never hide it, whatever their radius.
    palm = slice(15, 19)
    hides = capsules.finger != finger if finger >= 0 else np.ones(len(capsules.radius), dtype=bool)
    if finger < 0:
        hides[palm] = False
    hidden = np.zeros(cosine.shape, dtype=bool)
    begin = points + _LIFT_M * normals
    for number in np.flatnonzero(hides):
        # A marker whose whole surface is further off the capsule's line of sight than both sizes needs no test.
        hidden |= _crosses(begin, away, capsules.begin[:, number], capsules.end[:, number], capsules.radius[number])
    return cosine, np.where(hidden, 0.0, cosine)


def _crosses(begin: FloatArray, along: FloatArray, a: FloatArray, b: FloatArray, radius: float) -> BoolArray:
    """Tell which rays (N, S) from `begin` (N, S, 3) along unit vectors come within a radius of segments a–b (N, 3)."""
    _, _, apart2 = nearest(begin, along, a, b)
    crosses: BoolArray = apart2 < radius**2
    return crosses


def nearest(
    begin: FloatArray, along: FloatArray, a: FloatArray, b: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return where rays and segments are nearest to each other.

    The nearest points of two lines, clamped to the segment and to the ray (Ericson, "Real-Time Collision Detection",
    5.1.9).

    Args:
        begin: (N, S, 3) of the rays; broadcast.
        along: (N, S, 3) unit vectors.
        a, b: (N, 3) ends of the segments.

    Returns:
        (N, S) each: the distance along the ray; the place on the segment, 0 to 1; the squared distance between.
    """
    d = (b - a)[:, None]
    r = begin - a[:, None]
    dd = (d * d).sum(-1)
    ud = (along * d).sum(-1)
    ur, dr = (along * r).sum(-1), (d * r).sum(-1)
    denominator = np.maximum(dd - ud * ud, 1e-12)
    share = np.clip((dr - ud * ur) / denominator, 0.0, 1.0)
    ahead = np.maximum(share * ud - ur, 0.0)
    share = np.clip((dr + ahead * ud) / np.maximum(dd, 1e-12), 0.0, 1.0)
    apart = r + ahead[..., None] * along - share[..., None] * d
    return ahead, share, (apart * apart).sum(-1)
