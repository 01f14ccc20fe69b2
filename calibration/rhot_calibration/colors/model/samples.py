"""Pixels of each class, taken from the pictures, and pixels as they would look in other light."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Final

import cv2
import numpy as np

from rhot.arrays import BoolArray, FloatArray, ImageArray
from rhot.rig.colors import ColorComponent, log_ratio
from rhot_calibration.colors.model.fit import fit_mixture, rgb_of

LIGHT_CHANGE: Final = 0.2
"""Light is expected to change by at most this share between calibration and use."""

_LEAST_INNER: Final = 20
_MOST_PIXELS: Final = 20_000
_DRAWN_COMPONENTS: Final = 5
_PIXELS_PER_COMPONENT: Final = 120
_DRAW_FLOOR: Final = (0.004, 0.004, 0.01)
"""Least σ of the distribution that is drawn from: rounding to whole grey levels."""


@dataclass(frozen=True, slots=True)
class ClassPixels:
    """Pixels of known class.

    Attributes:
        markers: marker name to (N, 3) float64 red, green, blue, 0 to 255; without the mixed rim.
        skin, others: (N, 3) of skin and of all other surroundings; may be empty.
        area: mean area of each marker in a picture, pixels.
        others_area: pixels of surroundings (skin and others) in all pictures together.
        pictures: how many there are.
    """

    markers: dict[str, FloatArray]
    skin: FloatArray
    others: FloatArray
    area: dict[str, float]
    others_area: int
    pictures: int


def inner(region: BoolArray) -> BoolArray:
    """Return a region without its rim, where paint and surroundings mix; the region itself when too little is left."""
    eroded = cv2.erode(region.astype(np.uint8), np.ones((3, 3), np.uint8)) > 0
    return eroded if np.count_nonzero(eroded) >= _LEAST_INNER else region


def marker_pixels(images: Sequence[ImageArray], found: Sequence[Mapping[str, BoolArray]], name: str) -> FloatArray:
    """Return a marker's pixels in all pictures, (N, 3) float64 red, green, blue."""
    parts = [
        image[inner(chosen[name])][:, ::-1].astype(np.float64)
        for image, chosen in zip(images, found, strict=True)
        if name in chosen
    ]
    return np.concatenate(parts)


def thinned(pixels: FloatArray) -> FloatArray:
    """Return pixels, or evenly chosen ones where there are very many."""
    return pixels[:: max(1, -(-len(pixels) // _MOST_PIXELS))]


def in_other_light(pixels: FloatArray, rng: np.random.Generator) -> FloatArray:
    """Return pixels (N, 3) red, green, blue, each in light up to `LIGHT_CHANGE` brighter or darker, whole numbers."""
    light = rng.uniform(1.0 - LIGHT_CHANGE, 1.0 + LIGHT_CHANGE, (len(pixels), 1))
    return np.clip(np.rint(pixels * light), 0.0, 255.0)


def drawn(pixels: FloatArray, count: int, rng: np.random.Generator) -> FloatArray:
    """Return new pixels (count, 3) red, green, blue from the distribution of given ones, noise and all.

    The distribution is a mixture of normal ones in log-ratio space, fitted closely; `colors.json` holds wider ones.
    """
    features = log_ratio(pixels)
    components = fit_mixture(
        features, min(_DRAWN_COMPONENTS, max(1, len(pixels) // _PIXELS_PER_COMPONENT)), _DRAW_FLOOR
    )
    weights = np.array([component.weight for component in components])
    numbers = rng.multinomial(count, weights / weights.sum())
    parts = [_draw(component, int(number), rng) for component, number in zip(components, numbers, strict=True)]
    return rgb_of(np.concatenate(parts))


def _draw(component: ColorComponent, count: int, rng: np.random.Generator) -> FloatArray:
    samples: FloatArray = rng.multivariate_normal(component.mean(), component.covariance(), count)
    return samples
