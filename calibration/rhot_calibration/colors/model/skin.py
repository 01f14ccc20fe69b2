"""Which colours of the surroundings are skin: those of its hue that are found rather on the hand than elsewhere.

The hue alone does not tell: wooden desks and cardboard have that of skin, and dark skin in weak light is as dark as
many a desk. But what lies between and around the painted markers is mostly the hand, and most of the picture is not.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Final

import cv2
import numpy as np

from rhot.arrays import BoolArray, FloatArray, ImageArray, IndexArray
from rhot.rig.colors import ColorComponent, GaussianColor
from rhot_capture.detection.color_table import component_distances

_HUE: Final = ((0.02, 0.90), (-1.60, -0.02))
"""Bounds of ln(R/G) and ln(B/G) of skin in any ordinary light: more red than green, more green than blue."""
_BRIGHTNESS: Final = math.log(85.0)
"""Least brightness of skin where the pictures do not tell where the hand is: shadows have its hue, too."""
_FEWEST: Final = 4
"""Markers of a picture needed to tell where the hand is: fewer do not enclose any of it."""
_ROOM: Final = np.ones((21, 21), np.uint8)
"""The hand reaches 10 pixels beyond the hull of its markers."""
_STEP: Final = 2
"""Every second row and column is looked at."""
_OFTENER: Final = 1.5
"""Skin is this many times as frequent within the hull of the markers as elsewhere. About half of the hull is desk, seen
between the fingers, so a desk's colours are half as frequent there as elsewhere. Chosen."""


def are_skin(
    components: Sequence[ColorComponent], features: Sequence[FloatArray], found: Sequence[Mapping[str, BoolArray]]
) -> list[bool]:
    """Tell which components of the surroundings are skin.

    Args:
        components: normal distributions of the surroundings' colours.
        features: of each picture, (H, W, 3) colours in log-ratio space.
        found: of each picture, the pixels (H, W) of its markers.
    """
    if not components:
        return []
    surroundings, count = GaussianColor(components=tuple(components)), len(components)
    on_hand, elsewhere = np.zeros(count), np.zeros(count)
    for each, regions in zip(features, found, strict=True):
        if len(regions) < _FEWEST:
            continue
        painted: BoolArray = np.logical_or.reduce(list(regions.values()))
        hull, free = _hull(painted)[::_STEP, ::_STEP] > 0, ~painted[::_STEP, ::_STEP]
        squared = component_distances(surroundings, each[::_STEP, ::_STEP].reshape(-1, 3))
        nearest = squared.argmin(axis=0).reshape(hull.shape)
        on_hand += _shares(nearest[hull & free], count)
        elsewhere += _shares(nearest[~hull & free], count)
    if on_hand.any():
        likely: list[bool] = (on_hand > _OFTENER * elsewhere).tolist()
    else:
        likely = [float(component.mean()[2]) >= _BRIGHTNESS for component in components]
    return [is_likely and _has_hue(component) for component, is_likely in zip(components, likely, strict=True)]


def _shares(nearest: IndexArray, count: int) -> FloatArray:
    """Return the share of each of `count` components among pixels (N,) of these components."""
    shares: FloatArray = np.bincount(nearest, minlength=count) / max(float(len(nearest)), 1.0)
    return shares


def _hull(painted: BoolArray) -> ImageArray:
    """Return the convex hull of pixels (H, W), with some room around it, (H, W) uint8, nonzero inside."""
    v, u = np.nonzero(painted)
    drawn: ImageArray = np.zeros(painted.shape, np.uint8)
    cv2.fillConvexPoly(drawn, cv2.convexHull(np.column_stack([u, v]).astype(np.int32)), 1)
    return np.asarray(cv2.dilate(drawn, _ROOM), dtype=np.uint8)


def _has_hue(component: ColorComponent) -> bool:
    red, blue, _ = component.mean()
    (red_low, red_high), (blue_low, blue_high) = _HUE
    return bool(red_low <= red <= red_high and blue_low <= blue <= blue_high)
