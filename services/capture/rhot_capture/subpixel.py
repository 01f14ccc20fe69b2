"""Sub-pixel centre of a blob from how much of each rim pixel is paint.

A pixel at the rim mixes paint with what lies beside it, which may be black cloth here, bright skin there and a mixture
of these where they meet. With P the mean of the pure paint inside, μ and Σ mean and covariance of the colours around
the blob, the projection t = n·(c − μ) with n = (Σ + σ²I)⁻¹·(P − μ) is blind to the directions in which the
surroundings vary (the matched filter of spectral unmixing). Between its local levels outside (t₀) and inside (t₁),
α = (t − t₀)/(t₁ − t₀) is the painted share of a pixel. The centre is the centroid of α; blur spreads α evenly to both
sides of the rim and leaves its centroid.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import cv2
import numpy as np
from numpy.typing import NDArray

from rhot_capture.color_table import ImageArray

CoverageArray = NDArray[np.float32]

_RIM_OUTSIDE_PX: Final = 3
_RIM_INSIDE_PX: Final = 2
_REACH_PX: Final = 5
"""Half width of the window that looks for pure paint or surroundings; wider than the rim on both sides."""
_NOISE: Final = 5.0
"""σ, grey levels: variation of the surroundings that is no reason to avoid a direction."""
_MIN_CONTRAST: Final = 12.0
"""Grey levels between paint and surroundings below which their mixture cannot be told."""
_MIN_CORE_SHARE: Final = 0.08
ROUND_GAIN: Final = 1.2
_OVERSHOOT: Final = 0.25
"""Noise may push a share this far below 0 or above 1; clipping tighter would favour one side of the rim."""

_DISC_INSIDE: Final = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * _RIM_INSIDE_PX + 1, 2 * _RIM_INSIDE_PX + 1))
_DISC_OUTSIDE: Final = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * _RIM_OUTSIDE_PX + 1, 2 * _RIM_OUTSIDE_PX + 1))
_CROSS: Final = cv2.getStructuringElement(cv2.MORPH_CROSS, (3, 3))


@dataclass(frozen=True, slots=True)
class Centre:
    """Centre of a blob.

    Attributes:
        u, v: pixels, in the coordinates of the window.
        area: painted area, square pixels.
    """

    u: float
    v: float
    area: float


def coverage(image: ImageArray, mask: ImageArray) -> CoverageArray:
    """Return the painted share of every pixel of a window.

    Args:
        image: (h, w, 3) uint8, the window of the image.
        mask: (h, w) uint8, 255 where the pixels were taken for the marker, holes filled.

    Returns:
        (h, w) float32, 0 to 1 up to noise; exactly 0 and 1 away from the rim.
    """
    core = _core(mask)
    outside: ImageArray = np.asarray(cv2.bitwise_not(cv2.dilate(mask, _DISC_OUTSIDE)), dtype=np.uint8)
    around = image[outside > 0].astype(np.float32)
    if len(around) < 8:
        return _hard(mask)
    mean_around = np.einsum("ij->j", around) / len(around)
    around -= mean_around
    paint = np.array(cv2.mean(image, core)[:3]) - mean_around
    if np.linalg.norm(paint) < _MIN_CONTRAST:
        return _hard(mask)
    spread = around.T @ around / len(around) + _NOISE**2 * np.eye(3)
    direction = np.linalg.solve(spread, paint)
    direction /= direction @ paint
    projected = np.asarray(
        cv2.transform(
            image.astype(np.float32), np.append(direction, -direction @ mean_around).astype(np.float32)[None]
        ),
        dtype=np.float32,
    )
    # By now t is 0 in the mean of the surroundings and 1 in the mean of the paint; shading shifts both locally.
    inside_level = _local_mean(projected, core, 1.0)
    outside_level = _local_mean(projected, outside, 0.0)
    step = np.maximum(inside_level - outside_level, 0.2)
    share = np.clip((projected - outside_level) / step, -_OVERSHOOT, 1.0 + _OVERSHOOT)
    share[outside > 0] = 0.0
    if core is not mask:
        share[core > 0] = 1.0
    return np.asarray(share, dtype=np.float32)


def _core(mask: ImageArray) -> ImageArray:
    """Return the pixels that are surely pure paint; the whole mask when it is too small to have a rim and a core."""
    least = _MIN_CORE_SHARE * cv2.countNonZero(mask)
    for element in (_DISC_INSIDE, _CROSS):
        core: ImageArray = np.asarray(cv2.erode(mask, element), dtype=np.uint8)
        if cv2.countNonZero(core) > least:
            return core
    return mask


def _hard(mask: ImageArray) -> CoverageArray:
    return (mask > 0).astype(np.float32)


def _local_mean(values: CoverageArray, source: ImageArray, default: float) -> CoverageArray:
    """Return the mean of nearby source pixels at every pixel; `default` where there are none."""
    weights = _hard(source)
    size = (2 * _REACH_PX + 1, 2 * _REACH_PX + 1)
    count = cv2.boxFilter(weights, -1, size, normalize=False, borderType=cv2.BORDER_CONSTANT)
    total = cv2.boxFilter(values * weights, -1, size, normalize=False, borderType=cv2.BORDER_CONSTANT)
    return np.where(count > 0.5, total / np.maximum(count, 1.0), np.float32(default))


def centre_of(share: CoverageArray, round_part: bool = False) -> Centre:
    """Return the centroid of the painted share, whose sum must be above 0.

    Round parts are darker towards their edge, so that paint there looks like a mixture with a dark background and
    would count for less on the shaded side. Counting a share of 1 / `ROUND_GAIN` and more as full takes most of that
    back; it moves the rim outwards by the same small amount on all sides.

    Args:
        share: (h, w) float32.
        round_part: whether the paint covers something round, such as a fingertip.
    """
    moments = cv2.moments(np.minimum(ROUND_GAIN * share, 1.0) if round_part else share)
    total = moments["m00"]
    return Centre(moments["m10"] / total, moments["m01"] / total, float(share.sum()))
