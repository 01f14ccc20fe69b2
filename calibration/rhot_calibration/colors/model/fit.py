"""Fitting normal distributions in log-ratio space to colour samples, and telling how well two can be told apart."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Final

import cv2
import numpy as np

from rhot.arrays import BoolArray, FloatArray, ImageArray
from rhot.rig.colors import DARK_OFFSET, ColorComponent, RgbColor, log_ratio

# Pixels of each class, taken from the pictures, and pixels as they would look in other light.

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


MARKER_FLOOR: Final = (0.06, 0.06, 0.22)
"""Least σ of a marker's class: light changes between calibration and use, mostly its strength."""
COUNTER_FLOOR: Final = (0.05, 0.05, 0.10)
_GLOSS: Final = 12.0
"""Standard deviation of the white light that a surface reflects in addition to its own colour, grey levels. It differs
between calibration and use, because it depends on the angle. Over eleven rendered worlds, 12 together with the wider
limit of patches finds 93.8 instead of 93.1 % of the visible markers, with the same errors of their centres; at 25,
wrong names appear in one world."""
_CEILING: Final = (0.30, 0.30, 0.60)
_MAX_CORRELATION: Final = 0.95
_CLUSTER_SCALE: Final = (0.10, 0.10, 0.40)
"""What counts as equally far along the three axes when samples are clustered."""
_CLUSTER_SAMPLES: Final = 8_000


def fit_component(samples: FloatArray, floor: tuple[float, float, float], weight: float = 1.0) -> ColorComponent:
    """Fit one normal distribution, robustly: samples beyond three standard deviations are left out once.

    Args:
        samples: (N, 3) colours in log-ratio space, N at least 1.
        floor: least standard deviations.
        weight: of the component in its class.
    """
    mean, covariance = _moments(samples, floor)
    whitened = np.linalg.solve(np.linalg.cholesky(covariance), (samples - mean).T)
    inliers = np.einsum("ij,ij->j", whitened, whitened) <= 9.0
    if np.count_nonzero(inliers) > 0.5 * len(samples):
        mean, covariance = _moments(samples[inliers], floor)
    red, green, blue = (round(float(value), 1) for value in rgb_of(mean))
    return _component((red, green, blue), covariance, weight)


def with_gloss(component: ColorComponent, gloss: float = _GLOSS) -> ColorComponent:
    """Widen a component by more or less gloss than in the samples.

    Gloss adds white light to the colour of a surface (S. A. Shafer, "Using color to separate reflection components",
    Color Research and Application 10(4), 1985), so the component becomes wider in this direction only.

    Args:
        component: to widen.
        gloss: standard deviation of the white light, grey levels.
    """
    rgb = np.array(component.rgb)
    step = 0.5 * (log_ratio(np.minimum(rgb + gloss, 255.0)) - log_ratio(np.maximum(rgb - gloss, 0.0)))
    covariance = component.covariance() + np.outer(step, step)
    return _component(component.rgb, covariance, component.weight)


def _component(rgb: RgbColor, covariance: FloatArray, weight: float) -> ColorComponent:
    """Return a component as it is written to `colors.json`: within limits, rounded, and positive definite."""
    sigma = np.sqrt(np.diag(covariance))
    correlation = np.clip(covariance / np.outer(sigma, sigma), -_MAX_CORRELATION, _MAX_CORRELATION)
    sigma = np.minimum(sigma, _CEILING)
    values = [float(correlation[0, 1]), float(correlation[0, 2]), float(correlation[1, 2])]
    while np.linalg.eigvalsh(_correlation_matrix(values))[0] < 1e-3:
        values = [0.8 * value for value in values]
    first, second, third = (round(value, 3) for value in values)
    sigma_1, sigma_2, sigma_3 = (round(float(value), 4) for value in sigma)
    return ColorComponent(rgb=rgb, sigma=(sigma_1, sigma_2, sigma_3), correlation=(first, second, third), weight=weight)


def _moments(samples: FloatArray, floor: tuple[float, float, float]) -> tuple[FloatArray, FloatArray]:
    mean = samples.mean(axis=0)
    centred = samples - mean
    # Adding the floor's variance keeps the matrix positive and widens what was only seen in one light.
    covariance = centred.T @ centred / len(samples) + np.diag(np.square(floor))
    return mean, covariance


def _correlation_matrix(values: list[float]) -> FloatArray:
    matrix = np.eye(3)
    matrix[0, 1] = matrix[1, 0] = values[0]
    matrix[0, 2] = matrix[2, 0] = values[1]
    matrix[1, 2] = matrix[2, 1] = values[2]
    return matrix


def rgb_of(features: FloatArray) -> FloatArray:
    """Return the colours at places in log-ratio space, inverse of `rhot.rig.colors.log_ratio`.

    Args:
        features: (..., 3), no unit.

    Returns:
        (..., 3) float64 red, green, blue, 0 to 255.
    """
    brightness = np.exp(features[..., 2])
    red_ratio, blue_ratio = np.exp(features[..., 0]), np.exp(features[..., 1])
    green = 4.0 * brightness / (red_ratio + 2.0 + blue_ratio)
    return np.clip(np.stack([green * red_ratio, green, green * blue_ratio], axis=-1) - DARK_OFFSET, 0.0, 255.0)


def fit_mixture(samples: FloatArray, count: int, floor: tuple[float, float, float]) -> list[ColorComponent]:
    """Fit several normal distributions by clustering, the heaviest first.

    Args:
        samples: (N, 3) colours in log-ratio space.
        count: most clusters.
        floor: least standard deviations.
    """
    if len(samples) > _CLUSTER_SAMPLES:
        samples = samples[:: -(-len(samples) // _CLUSTER_SAMPLES)]
    count = max(1, min(count, len(samples) // 50))
    scaled = (samples / _CLUSTER_SCALE).astype(np.float32)
    cv2.setRNGSeed(1)
    criteria = (cv2.TERM_CRITERIA_EPS + cv2.TERM_CRITERIA_MAX_ITER, 30, 0.01)
    labels = np.zeros((len(scaled), 1), np.int32)
    _, labels_found, _ = cv2.kmeans(scaled, count, labels, criteria, 2, cv2.KMEANS_PP_CENTERS)
    cluster = np.asarray(labels_found).ravel()
    components = []
    for number in range(count):
        members = samples[cluster == number]
        if len(members) >= 10:
            components.append(fit_component(members, floor, round(max(len(members) / len(samples), 1e-3), 4)))
    return sorted(components, key=lambda component: component.weight, reverse=True)


def bhattacharyya(first: ColorComponent, second: ColorComponent) -> float:
    """Return the Bhattacharyya distance of two normal distributions.

    Their classes are mixed up in at most ½·exp(−distance) of the cases (Fukunaga 1990, section 3.4).
    """
    difference = log_ratio(np.array(first.rgb)) - log_ratio(np.array(second.rgb))
    covariance_1, covariance_2 = first.covariance(), second.covariance()
    mean_covariance = 0.5 * (covariance_1 + covariance_2)
    _, log_mean = np.linalg.slogdet(mean_covariance)
    _, log_1 = np.linalg.slogdet(covariance_1)
    _, log_2 = np.linalg.slogdet(covariance_2)
    squared = float(difference @ np.linalg.solve(mean_covariance, difference))
    return 0.125 * squared + 0.5 * float(log_mean - 0.5 * (log_1 + log_2))
