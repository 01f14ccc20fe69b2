"""Where skin adjoins the paint of a fingertip in an image, as capture states it (`Marker.skin_side`).

Around the blob, as far outside as capture looks, rays are cast. One sees skin when it meets a finger or the palm before
the object in the hand, and that not where another cap is painted.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

import numpy as np

from rhot.arrays import BoolArray, FloatArray
from rhot.geometry.camera import CameraModel
from rhot_bench.motion.painted import Capsules, Surface, nearest

_DIRECTIONS: Final = 16
_OUTSIDE_PX: Final = 3.5
"""Capture's ring is 2.5 to 4.5 pixels outside of the paint."""
_FLESH: Final = 19
"""`Flesh.capsules` begins with fifteen bones of fingers and four of the palm; what is held comes after."""
_SPACING_M: Final = 0.001
"""The paint reaches about so much further than the middle of its outermost sample."""


def skin_sides(
    camera: CameraModel,
    uv: FloatArray,
    pixels: FloatArray,
    depth_m: FloatArray,
    shown: FloatArray,
    capsules: Capsules,
    caps: Sequence[Surface],
) -> FloatArray:
    """Return the mean (N, 2) over a ring around a blob of the unit vectors to skin, those to anything else counting 0.

    Args:
        camera: that sees it.
        uv: (N, 2) its centroid, pixels.
        pixels: (N, S, 2) samples of its paint.
        depth_m: (N, S) their depths.
        shown: (N, S) > 0 where the camera sees them.
        capsules: of the N moments.
        caps: of the five fingers.
    """
    count = len(uv)
    turns = np.arange(_DIRECTIONS) * (2.0 * np.pi / _DIRECTIONS)
    directions = np.column_stack([np.cos(turns), np.sin(turns)])
    reach = np.where(shown[..., None] > 0.0, (pixels - uv[:, None]) @ directions.T, 0.0).max(axis=1)
    reach += (_OUTSIDE_PX + _SPACING_M * camera.K[0, 0] / depth_m[:, 0])[:, None]
    ring = uv[:, None] + reach[..., None] * directions
    rays = camera.rays(ring.reshape(-1, 2)).reshape(count, _DIRECTIONS, 3)
    sides: FloatArray = (_sees_skin(camera.center, rays, capsules, caps)[..., None] * directions).mean(axis=1)
    return sides


def _sees_skin(eye: FloatArray, rays: FloatArray, capsules: Capsules, caps: Sequence[Surface]) -> BoolArray:
    """Tell which rays (N, D, 3) from the camera's centre (3,) meet skin first."""
    first_m = np.full(rays.shape[:2], np.inf)
    skin = np.zeros(rays.shape[:2], dtype=bool)
    for number, radius in enumerate(capsules.radius.tolist()):
        begin, end = capsules.begin[:, number], capsules.end[:, number]
        ahead, share, apart2 = nearest(eye, rays, begin, end)
        # The distance of the nearest point of the axis, less what the radius leaves, tells bones apart that lie behind
        # each other.
        met_m = np.where(apart2 < radius**2, ahead - np.sqrt(np.maximum(radius**2 - apart2, 0.0)), np.inf)
        first = met_m < first_m
        first_m = np.where(first, met_m, first_m)
        is_skin = np.full(first.shape, number < _FLESH)
        finger = int(capsules.finger[number])
        if finger >= 0:
            # The capsule ends one radius before the very tip, from where the paint's length counts.
            from_tip_m = radius + (1.0 - share) * np.linalg.norm(end - begin, axis=1)[:, None]
            is_skin = from_tip_m > caps[finger].points[:, 2].max() + _SPACING_M
        skin = np.where(first, is_skin, skin)
    return skin
