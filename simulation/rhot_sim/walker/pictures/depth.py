"""The depth image: rays against floor, legs and marker cards, then what a stereo camera makes of it.

Rays are cast at half the picture's size, which is what librealsense's decimation filter leaves, and each value fills
two by two pixels of the aligned image. Stereo measures disparity, so the errors are made there: with the focal length f
and the baseline B of the depth imagers,

    z' = f · B / round(f · B / z + n),   σ_z = z² · σ_n / (f · B),

with noise n that neighbouring pixels share, the rounding being the device's 1/32 of a pixel. Outlines are ragged,
what the second imager cannot see beside a near thing is missing, and so are glancing floors and blots of dark cloth.
Not modelled: the shift between colour and depth imager (15 mm), and what motion does to the match.
"""

from __future__ import annotations

import hashlib
from dataclasses import dataclass
from typing import Final

import cv2
import numpy as np
from numpy.typing import NDArray

from rhot.arrays import FloatArray
from rhot.messages import Side
from rhot_sim.walker.foot_path import SIDES
from rhot_sim.walker.person import Person, PersonSample
from rhot_sim.walker.pictures.camera import BASELINE_M, DEPTH_FOCAL_PX

# What the camera sees of the person: trousers and shoes as rounded cones, and the card that carries each marker.

CARD_SHARE: Final = 1.3
"""Side of the white card over that of the marker's black square."""
REFERENCE_HEIGHT_M: Final = 1.75
SHOE_M: Final = (
    # Ends (x, y over the floor, z from the ankle) and radii, metres, of a person of the reference height.
    (((0.0, 0.040, 0.032), 0.036), ((0.0, 0.034, -0.060), 0.036)),
    (((0.0, 0.036, -0.040), 0.036), ((0.0, 0.026, -0.130), 0.026)),
    (((0.0, 0.030, -0.110), 0.034), ((0.0, 0.026, -0.165), 0.024)),
)
SHANK_RADII_M: Final = (0.054, 0.038)
THIGH_RADII_M: Final = (0.078, 0.058)
TRUNK_RADII_M: Final = (0.125, 0.120)
HEM_OVER_ANKLE_M: Final = 0.085
"""Trousers end this far over the ankle."""
SHOE, TROUSERS, SHIRT = "shoe", "trousers", "shirt"


@dataclass(frozen=True, slots=True)
class Cone:
    """A cone with round ends, in the picture of one moment.

    Attributes:
        ends: (2, 3) centres of the two balls, metres, rig frame.
        radii: (2,) of these, metres.
        paint: what it is made of.
    """

    ends: FloatArray
    radii: FloatArray
    paint: str


@dataclass(frozen=True, slots=True)
class Limbs:
    """A person's solids at one moment.

    Attributes:
        shoes: side to the cones of the shoe.
        legs: side to trousers, shank before thigh.
        trunk: the upper body.
    """

    shoes: dict[Side, list[Cone]]
    legs: dict[Side, list[Cone]]
    trunk: Cone

    @property
    def cones(self) -> list[Cone]:
        """All of them."""
        return [cone for part in (self.shoes, self.legs) for side in SIDES for cone in part[side]] + [self.trunk]


def limbs_at(person: Person, sample: PersonSample, moment: int) -> Limbs:
    """Return the solids of a person at one of a sample's moments."""
    scale = person.body.height_m / REFERENCE_HEIGHT_M
    shoes: dict[Side, list[Cone]] = {}
    legs: dict[Side, list[Cone]] = {}
    for side in SIDES:
        T, leg, hip = sample.ankles[side][moment], sample.legs[side], sample.hip_joints[side][moment]
        shoes[side] = [_shoe_part(T, ends, scale, person.sole.ankle_height_m) for ends in SHOE_M]
        knee = leg.knee[moment]
        hem = T[:3, 3] + HEM_OVER_ANKLE_M * leg.R_shank[moment, :, 1]
        legs[side] = [
            Cone(np.stack([knee, hem]), np.array(SHANK_RADII_M) * scale, TROUSERS),
            Cone(np.stack([hip, knee]), np.array(THIGH_RADII_M) * scale, TROUSERS),
        ]
    hips, neck = sample.hips[moment, :3, 3], sample.neck[moment]
    # Ends of the trunk between hips and neck, as shares of the way.
    trunk = hips + np.outer((0.12, 0.75), neck - hips)
    return Limbs(shoes, legs, Cone(trunk, np.array(TRUNK_RADII_M) * scale, SHIRT))


def _shoe_part(
    T: FloatArray, part: tuple[tuple[tuple[float, float, float], float], ...], scale: float, ankle_height_m: float
) -> Cone:
    local = scale * np.array([center for center, _ in part])
    radii = scale * np.array([radius for _, radius in part])
    local[:, 1] -= ankle_height_m
    ends = local @ T[:3, :3].T + T[:3, 3]
    # Soles bend: a foot on its ball does not push its toes through the floor.
    ends[:, 1] = np.maximum(ends[:, 1], radii)
    return Cone(ends, radii, SHOE)


Float32Array = NDArray[np.float32]
DepthImage = NDArray[np.uint16]

DISPARITY_SIGMA_PX: Final = 0.09
DISPARITY_STEP_PX: Final = 1.0 / 32.0
MIN_DEPTH_M: Final = 0.20
MAX_DEPTH_M: Final = 6.0
_FOCAL_TIMES_BASELINE: Final = DEPTH_FOCAL_PX * BASELINE_M
_STEADY_SHARE: Final = 0.5
"""Part of the noise's variance that stays from frame to frame."""
_MARGIN_PX: Final = 64
_NEAREST_M: Final = 0.05
_GRAIN_PX: Final = 1.0
_BLOT_PX: Final = 2.0
_BLOT: Final = 2.6
"""Blots of noise above this are holes on anything but the floor."""
_RAGGED_PX: Final = 0.8
_RAGGED_KINDS: Final = 4
_GRAZING: Final = 0.12
"""Cosine between a ray and the floor's normal below which the floor tends to be missing."""
_EDGE_PX: Final = 1.2
"""Step of disparity that tends to leave holes along it."""


class DepthRenderer:
    """Depth images of one camera; the same arguments give the same values.

    Args:
        K: (3, 3) intrinsics of the full picture, pixels.
        width, height: of the full picture.
        rng: chooses the noise.
        noise: scales all noise; 0 leaves the geometry alone.
    """

    def __init__(self, K: FloatArray, width: int, height: int, rng: np.random.Generator, noise: float = 1.0) -> None:
        self._size = (width, height)
        self._shape = ((height + 1) // 2, (width + 1) // 2)
        rows, columns = self._shape
        # The middle of two by two pixels.
        self._focal = (K[0, 0] / 2.0, K[1, 1] / 2.0)
        self._center = ((K[0, 2] - 0.5) / 2.0, (K[1, 2] - 0.5) / 2.0)
        u = (np.arange(columns) - self._center[0]) / self._focal[0]
        v = (np.arange(rows) - self._center[1]) / self._focal[1]
        rays = np.ones((rows, columns, 3), dtype=np.float32)
        rays[..., 0], rays[..., 1] = u, v[:, None]
        self._rays: Float32Array = rays
        self._lengths: Float32Array = np.linalg.norm(rays, axis=-1).astype(np.float32)
        self._noise = noise
        self._grain = _field(rows + _MARGIN_PX, columns + _MARGIN_PX, rng, _GRAIN_PX)
        self._blots = _field(rows + _MARGIN_PX, columns + _MARGIN_PX, rng, _BLOT_PX)
        grid_v, grid_u = np.mgrid[:rows, :columns].astype(np.float32)
        self._ragged = [
            tuple(grid + np.float32(_RAGGED_PX) * _field(rows, columns, rng, _BLOT_PX) for grid in (grid_u, grid_v))
            for _ in range(_RAGGED_KINDS)
        ]

    def geometry(self, T_rig_camera: FloatArray, cones: list[Cone], cards: list[FloatArray]) -> Float32Array:
        """Return true depths (H/2, W/2), metres along the optical axis, 0 where there is nothing within reach.

        Args:
            T_rig_camera: (4, 4).
            cones: the person.
            cards: poses (4, 4) of squares in the rig frame whose x and z axes end at the edges of the card.
        """
        return self._cast(T_rig_camera, cones, cards)[0]

    def render(self, T_rig_camera: FloatArray, cones: list[Cone], cards: list[FloatArray], key: str) -> DepthImage:
        """Return the depth image (H, W), millimetres, 0 = none; `key` chooses its noise."""
        depth, glancing = self._cast(T_rig_camera, cones, cards)
        if self._noise > 0.0:
            depth = self._measured(depth, glancing, key)
        millimetres = np.minimum(1000.0 * depth + 0.5, 65535.0).astype(np.uint16)
        width, height = self._size
        full: DepthImage = millimetres.repeat(2, axis=0).repeat(2, axis=1)[:height, :width]
        return np.ascontiguousarray(full)

    def _cast(
        self, T_rig_camera: FloatArray, cones: list[Cone], cards: list[FloatArray]
    ) -> tuple[Float32Array, Float32Array]:
        """Return true depths, and the cosine between ray and floor's normal where the floor is seen, else 1."""
        R, t = T_rig_camera[:3, :3], T_rig_camera[:3, 3]
        fall = -(self._rays @ R[1].astype(np.float32))
        with np.errstate(divide="ignore"):
            floor: Float32Array = np.where(fall > 1e-4, np.float32(t[1]) / fall, np.float32(np.inf))
        depth = floor.copy()
        for cone in cones:
            self._add_cone(depth, (cone.ends - t) @ R, cone.radii)
        for card in cards:
            self._add_card(depth, (card[:3, 3] - t) @ R, R.T @ card[:3, :3])
        glancing: Float32Array = np.where(depth < floor, np.float32(1.0), fall / self._lengths)
        depth[(depth < MIN_DEPTH_M) | (depth > MAX_DEPTH_M)] = 0.0
        return depth, glancing

    def _add_cone(self, depth: Float32Array, ends: FloatArray, radii: FloatArray) -> None:
        """Put a cone with round ends, camera frame, in front of what is farther.

        It is the union of the balls between its ends; a ray t·d meets it where its distance from the moving ball's
        centre equals the ball's radius, a quadratic in t, or at one of the end balls.
        """
        window = self._window(ends, radii)
        if window is None:
            return
        lengths = self._lengths[window]
        axis = ends[1] - ends[0]
        # Plain floats, which leave arrays of single precision as they are.
        first, second = float(radii[0]), float(radii[1])
        narrowing, axis2 = first - second, float(axis @ axis)
        start2, start_axis = float(ends[0] @ ends[0]), float(-ends[0] @ axis)
        end2 = float(ends[1] @ ends[1])
        slant = axis2 - narrowing**2
        both = self._rays[window] @ np.stack([axis, -ends[0]], axis=-1).astype(np.float32)
        ray_axis, ray_start = both[..., 0] / lengths, both[..., 1] / lengths
        k2 = slant - ray_axis**2
        k1 = slant * ray_start - (start_axis - narrowing * first) * ray_axis
        k0 = slant * start2 - start_axis**2 + 2.0 * start_axis * narrowing * first - axis2 * first**2
        h = k1 * k1 - k0 * k2
        with np.errstate(invalid="ignore", divide="ignore"):
            t = (-np.sqrt(h) - k1) / k2
            along = t * ray_axis + (start_axis - first * narrowing)
            near = np.where((along > 0.0) & (along < slant) & (t > 0.0), t, np.float32(np.inf))
            for towards, c in ((ray_start, start2 - first**2), (ray_start - ray_axis, end2 - second**2)):
                t = -towards - np.sqrt(towards * towards - c)
                near = np.fmin(near, np.where(t > 0.0, t, np.float32(np.inf)))
        part = depth[window]
        np.minimum(part, near / lengths, out=part)

    def _add_card(self, depth: Float32Array, center: FloatArray, axes: FloatArray) -> None:
        """Put a card, camera frame, in front of what is farther; columns 0 and 2 of `axes` are half its sides."""
        half = float(np.linalg.norm(axes[:, 0]))
        window = self._window(np.stack([center, center]), np.full(2, 1.5 * half))
        if window is None:
            return
        normal = axes[:, 1]
        slope = self._rays[window] @ normal.astype(np.float32)
        with np.errstate(divide="ignore", invalid="ignore"):
            z = np.float32(center @ normal) / slope
            points = self._rays[window] * z[..., None] - center.astype(np.float32)
            place = np.abs(points @ (axes[:, ::2] / half**2).astype(np.float32))
            hit = (place.max(axis=-1) <= 1.0) & (z > 0.0)
        part = depth[window]
        np.minimum(part, z, out=part, where=hit)

    def _window(self, ends: FloatArray, radii: FloatArray) -> tuple[slice, slice] | None:
        """Return rows and columns around two balls, camera frame; None when they cannot be seen."""
        far = float((ends[:, 2] + radii).max())
        if far <= _NEAREST_M:
            return None
        depths = np.array([max(float((ends[:, 2] - radii).min()), _NEAREST_M), far])
        low: list[int] = []
        high: list[int] = []
        for axis, size in ((1, self._shape[0]), (0, self._shape[1])):
            # Whatever of it is seen lies between these bounds and these depths.
            bounds = np.array([(ends[:, axis] - radii).min(), (ends[:, axis] + radii).max()])
            pixels = self._center[axis] + self._focal[axis] * bounds[:, None] / depths
            low.append(max(0, int(np.floor(pixels.min())) - 1))
            high.append(min(size, int(np.ceil(pixels.max())) + 2))
        if low[0] >= high[0] or low[1] >= high[1]:
            return None
        return slice(low[0], high[0]), slice(low[1], high[1])

    def _measured(self, depth: Float32Array, glancing: Float32Array, key: str) -> Float32Array:
        """Return depths as a stereo camera measures them, 0 where it fails."""
        random = np.frombuffer(hashlib.blake2b(key.encode(), digest_size=8).digest(), dtype=np.uint16)
        map_u, map_v = self._ragged[random[0] % len(self._ragged)]
        depth = np.asarray(
            cv2.remap(depth, map_u, map_v, cv2.INTER_NEAREST, borderMode=cv2.BORDER_REPLICATE), dtype=np.float32
        )
        with np.errstate(divide="ignore"):
            disparity: Float32Array = np.where(depth > 0.0, np.float32(_FOCAL_TIMES_BASELINE) / depth, np.float32(0.0))
        missing = self._missing(disparity, glancing, self._cut(self._blots, random[2], random[3]))
        sigma = DISPARITY_SIGMA_PX * self._noise
        disparity += np.float32(sigma * (1.0 - _STEADY_SHARE) ** 0.5) * self._cut(self._grain, random[1], random[2])
        disparity += np.float32(sigma * _STEADY_SHARE**0.5) * self._cut(self._grain, 0, 0)
        np.rint(disparity * np.float32(1.0 / DISPARITY_STEP_PX), out=disparity)
        missing |= disparity < 1.0
        np.maximum(disparity, 1.0, out=disparity)
        measured: Float32Array = np.float32(_FOCAL_TIMES_BASELINE / DISPARITY_STEP_PX) / disparity
        measured[missing] = 0.0
        return measured

    def _missing(self, disparity: Float32Array, glancing: Float32Array, blots: Float32Array) -> NDArray[np.bool_]:
        """Return where matching fails: in shadows, along edges, on glancing floor, in blots, and where nothing is."""
        missing: NDArray[np.bool_] = disparity <= 0.0
        missing |= glancing < _GRAZING * (1.0 + 0.3 * blots)
        missing |= (blots > _BLOT) & (glancing == 1.0)
        # Pixels of this picture to which a pixel of disparity comes.
        per_pixel = DEPTH_FOCAL_PX / self._focal[0]
        shadow_px = 8
        for shift in range(1, shadow_px + 1):
            missing[:, :-shift] |= disparity[:, shift:] - disparity[:, :-shift] > np.float32(shift * per_pixel)
        across = np.abs(disparity[:, 2:] - disparity[:, :-2]) > _EDGE_PX
        missing[:, 1:-1] |= across & (blots[:, 1:-1] > 0.0)
        down = np.abs(disparity[2:] - disparity[:-2]) > _EDGE_PX
        missing[1:-1] |= down & (blots[1:-1] > 0.0)
        return missing

    def _cut(self, field: Float32Array, x: int, y: int) -> Float32Array:
        """Return the part of a noise field that lies at a place of its own."""
        rows, columns = self._shape
        left, top = int(x) % _MARGIN_PX, int(y) % _MARGIN_PX
        return field[top : top + rows, left : left + columns]


def _field(rows: int, columns: int, rng: np.random.Generator, smooth_px: float) -> Float32Array:
    """Return normal noise (rows, columns) of variance 1 that is smooth over so many pixels."""
    white = rng.standard_normal((rows, columns), dtype=np.float32)
    field: Float32Array = np.asarray(cv2.GaussianBlur(white, (0, 0), smooth_px), dtype=np.float32)
    field /= field.std()
    return field
