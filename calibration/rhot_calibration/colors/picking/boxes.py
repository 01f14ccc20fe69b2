"""From a rectangle around a marker to the marker's own pixels: the dominant colour in it that is not around it."""

from __future__ import annotations

from typing import Final

import cv2
import numpy as np

from rhot.arrays import BoolArray, FloatArray
from rhot.rig.colors import GaussianColor
from rhot_calibration.colors.model.fit import COUNTER_FLOOR, fit_component, fit_mixture
from rhot_calibration.colors.picking.picks import Box
from rhot_capture.detection.color_table import mixture_fit

_RING_SHARE: Final = 0.5
_LEAST_RING_PX: Final = 6
_SURROUNDINGS: Final = 6
_MODE_SCALE: Final = (0.10, 0.10, 0.35)
"""Width of the neighbourhood in log-ratio space in which colours count as one paint when the dominant one is sought."""
_MODE_SAMPLES: Final = 400
_FIT_FLOOR: Final = (0.045, 0.045, 0.15)
_LIMIT: Final = 3.0
_ROUNDS: Final = 6
_LEAST_SHARE: Final = 0.1
"""A marker fills at least this share of its rectangle."""
_STANDS_OUT: Final = 2.0
"""Logarithm of how much rarer a colour must be around the rectangle than evenly spread colours would be."""
_EVEN_DENSITY: Final = 0.0


def box_region(features: FloatArray, box: Box, others: BoolArray) -> BoolArray:
    """Return the marker's pixels in a rectangle, (H, W) bool; all False where nothing in it stands out.

    Args:
        features: (H, W, 3) float64, the picture in log-ratio space.
        box: the rectangle, at least partly inside the picture.
        others: (H, W) bool, where other markers are: they do not count as surroundings.
    """
    height, width = others.shape
    inside = _window(box, 0, height, width)
    reach = max(_LEAST_RING_PX, round(_RING_SHARE * max(box.width, box.height)))
    around = np.zeros(others.shape, bool)
    around[_window(box, reach, height, width)] = True
    around[inside] = False
    region = np.zeros(others.shape, bool)
    # A rectangle drawn inside its marker has the same paint around it: the rest of the picture is the reference then.
    far = np.ones(others.shape, bool)
    far[_window(box, 3 * reach, height, width)] = False
    for reference in (around & ~others, far & ~others):
        samples = features[reference]
        if len(samples) < _MODE_SAMPLES // 4:
            continue
        found = _dominant(features[inside], samples)
        if np.count_nonzero(found) >= _LEAST_SHARE * found.size:
            region[inside] = found
            return region
    return region


def _window(box: Box, reach: int, height: int, width: int) -> tuple[slice, slice]:
    left, top = round(box.u) - reach, round(box.v) - reach
    right, bottom = round(box.u + box.width) + reach, round(box.v + box.height) + reach
    return slice(max(top, 0), min(bottom, height)), slice(max(left, 0), min(right, width))


def _dominant(inside: FloatArray, around: FloatArray) -> BoolArray:
    """Return the pixels of the dominant colour in a rectangle, (h, w) bool.

    Args:
        inside: (h, w, 3) the rectangle in log-ratio space.
        around: (N, 3) what surrounds it.
    """
    shape = inside.shape[:2]
    flat = inside.reshape(-1, 3)
    reference = GaussianColor(components=tuple(fit_mixture(around, _SURROUNDINGS, COUNTER_FLOOR)))
    surroundings, _ = mixture_fit(reference, flat)
    candidates = flat[surroundings < _EVEN_DENSITY - _STANDS_OUT]
    if len(candidates) < _LEAST_SHARE * len(flat):
        return np.zeros(shape, bool)
    own = candidates[_near(candidates, _mode(candidates))]
    region = np.zeros(shape, bool)
    for _ in range(_ROUNDS):
        color = GaussianColor(components=(fit_component(own, _FIT_FLOOR),))
        density, squared = mixture_fit(color, flat)
        fits = ((squared <= _LIMIT**2) & (density > surroundings)).reshape(shape)
        grown = _largest(fits)
        if not grown.any() or np.array_equal(grown, region):
            break
        region = grown
        own = inside[region]
    return region


def _mode(samples: FloatArray) -> FloatArray:
    """Return the colour with the most like it."""
    chosen = samples[:: -(-len(samples) // _MODE_SAMPLES)]
    scaled = chosen / _MODE_SCALE
    squared = np.square(scaled[:, None] - scaled[None]).sum(axis=-1)
    mode: FloatArray = chosen[int(np.exp(-0.5 * squared).sum(axis=1).argmax())]
    return mode


def _near(samples: FloatArray, colour: FloatArray) -> BoolArray:
    near: BoolArray = np.square((samples - colour) / _MODE_SCALE).sum(axis=-1) <= _LIMIT**2 / 2.0
    return near


def _largest(fits: BoolArray) -> BoolArray:
    opened = cv2.morphologyEx(fits.astype(np.uint8), cv2.MORPH_OPEN, np.ones((3, 3), np.uint8))
    contours, _ = cv2.findContours(opened, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
    filled = np.zeros(fits.shape, np.uint8)
    if contours:
        # Highlights inside the outline are paint too.
        cv2.drawContours(filled, [max(contours, key=cv2.contourArea)], -1, 1, cv2.FILLED)
    return filled > 0
