"""What the camera sees beside the hand: the desk under its black cloth, and the sensor's noise."""

from __future__ import annotations

from typing import Final

import cv2
import numpy as np
from numpy.typing import NDArray

from rhot_sim.world.paint import DESK

Image = NDArray[np.uint8]

_NOISE_MARGIN_PX: Final = 128


def desk_image(width: int, height: int, rng: np.random.Generator) -> NDArray[np.float32]:
    """Return the desk in even light, (height, width, 3): black cloth with soft folds, a rail, a keyboard's corner."""
    coarse = rng.normal(0.0, 1.0, (12, 16)).astype(np.float32)
    fine = rng.normal(0.0, 1.0, (60, 80)).astype(np.float32)
    size = (width, height)
    folds = 3.0 * cv2.resize(coarse, size, interpolation=cv2.INTER_CUBIC)
    weave = 0.8 * cv2.resize(fine, size, interpolation=cv2.INTER_LINEAR)
    image = (np.array(DESK, dtype=np.float32) + (folds + weave)[..., None]).astype(np.float32)
    rail_x, rail_y = round(0.012 * width), round(height * rng.uniform(0.2, 0.5))
    cv2.rectangle(image, (0, rail_y), (rail_x, rail_y + height // 6), (178.0, 176.0, 170.0), -1)
    corner = np.array([[0.94, 0.0], [1.0, 0.0], [1.0, 0.13]]) * size
    cv2.fillConvexPoly(image, np.round(corner).astype(np.int32), (74.0, 70.0, 68.0))
    return np.asarray(cv2.GaussianBlur(image, (0, 0), 0.8), dtype=np.float32)


class Backdrop:
    """The desk at several brightnesses, at the picture's size and enlarged for drawing on.

    Args:
        width, height: of the picture, pixels.
        scale: of the enlarged one.
        drift: relative amplitude of the light's drift.
        rng: chooses the folds.
    """

    def __init__(self, width: int, height: int, scale: int, drift: float, rng: np.random.Generator) -> None:
        desk = desk_image(width, height, rng)
        self._drift = drift
        light_levels = 5
        count = light_levels if drift > 0.0 else 1
        self._levels = np.linspace(1.0 - drift, 1.0 + drift, count)
        self._plain: list[Image] = [np.clip(np.round(desk * level), 0, 255).astype(np.uint8) for level in self._levels]
        self._large: list[Image] = [image.repeat(scale, axis=0).repeat(scale, axis=1) for image in self._plain]

    def at(self, light: float) -> tuple[Image, Image]:
        """Return the desk nearest to a brightness: at the picture's size, and enlarged. Not to be written to."""
        level = int(np.argmin(np.abs(self._levels - light)))
        return self._plain[level], self._large[level]


class SensorNoise:
    """Normal noise, drawn once and laid over each picture at an offset of its own.

    Rounded to grey levels its variance is σ² + 1/12.

    Args:
        width, height: of the picture, pixels.
        sigma: standard deviation, grey levels.
        rng: chooses the noise.
    """

    def __init__(self, width: int, height: int, sigma: float, rng: np.random.Generator) -> None:
        self._width, self._height = width, height
        self._sigma = sigma
        if sigma > 0.0:
            shape = (height + _NOISE_MARGIN_PX, width + _NOISE_MARGIN_PX, 3)
            noise = np.round(sigma * rng.standard_normal(shape, dtype=np.float32))
            # Two saturating operations on bytes are several times quicker than one on wider numbers.
            self._brighter: Image = np.clip(noise, 0, 255).astype(np.uint8)
            self._darker: Image = np.clip(-noise, 0, 255).astype(np.uint8)

    def add(self, image: Image, number: int) -> None:
        """Add noise to an image in place; `number` (any whole number) chooses which."""
        if self._sigma <= 0.0:
            return
        y, x = divmod(number % (_NOISE_MARGIN_PX * _NOISE_MARGIN_PX), _NOISE_MARGIN_PX)
        window = (slice(y, y + self._height), slice(x, x + self._width))
        cv2.add(image, self._brighter[window], dst=image)
        cv2.subtract(image, self._darker[window], dst=image)
