"""Cameras that differ in white balance and exposure are told apart from paints."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from rhot_calibration.colors.calibration import calibrate, camera_gains
from rhot_capture.detection.color_table import camera_tables
from rhot_capture.detection.detector import MarkerDetector

WARM, COLD = np.array([0.75, 1.0, 1.2]), np.array([1.2, 0.95, 0.7])
"""Factors on blue, green and red."""
CAMERAS = ["left", "right"]


def lit(image: Any, factors: Any) -> Any:
    return np.clip(np.rint(image * factors), 0, 255).astype(np.uint8)


def flat(*colours: tuple[float, float, float]) -> tuple[Any, dict[str, Any]]:
    """Return a picture of stripes, blue, green, red each, and where each is."""
    image = np.zeros((20, 20 * len(colours), 3))
    regions = {}
    for number, colour in enumerate(colours):
        where = np.zeros(image.shape[:2], bool)
        where[:, 20 * number : 20 * number + 20] = True
        image[where] = colour
        regions[f"m{number}"] = where
    return image, regions


def test_factors_undo_what_each_camera_does() -> None:
    image, regions = flat((60, 70, 180), (150, 60, 60), (70, 160, 80), (90, 150, 160))
    gains = camera_gains([lit(image, WARM), lit(image, COLD)], [regions, regions], CAMERAS)
    red, green, blue = np.array(gains["left"]) / np.array(gains["right"])
    assert [blue, green, red] == pytest.approx((COLD / WARM).tolist(), rel=0.02)
    assert np.prod([gains["left"], gains["right"]], axis=0) == pytest.approx((1.0, 1.0, 1.0), abs=0.002)


def test_a_paint_that_is_cut_off_or_wrongly_picked_says_nothing() -> None:
    image, regions = flat((60, 70, 180), (150, 60, 60), (70, 160, 80), (250, 250, 250), (90, 150, 160))
    right = lit(image, COLD)
    right[regions["m4"]] = (20, 200, 20)
    gains = camera_gains([lit(image, WARM), right], [regions, regions], CAMERAS)
    red, green, blue = np.array(gains["left"]) / np.array(gains["right"])
    assert [blue, green, red] == pytest.approx((COLD / WARM).tolist(), rel=0.05)


def test_without_enough_paints_or_cameras_nothing_is_balanced() -> None:
    image, regions = flat((60, 70, 180), (150, 60, 60))
    pictures = [lit(image, WARM), lit(image, COLD)]
    assert camera_gains(pictures, [regions, regions], CAMERAS) == {}
    image, regions = flat((60, 70, 180), (150, 60, 60), (70, 160, 80))
    pictures = [lit(image, WARM), lit(image, COLD)]
    assert camera_gains(pictures, [regions, regions], ["left", None]) == {}
    assert camera_gains(pictures, [regions, regions], ["left", "left"]) == {}


def test_colours_of_two_unlike_cameras_are_as_narrow_as_those_of_one(scene: Any, six_shapes: Any, markers: Any) -> None:
    drawn = scene(six_shapes(1), noise=2.0)
    images = [lit(drawn.image, 0.85 * WARM), lit(drawn.image, 0.85 * COLD)]
    picks = {name: (u, v) for name, (u, v, _) in drawn.truth.items()}
    y, x = np.indices(drawn.image.shape[:2])
    regions = {name: np.hypot(x - u, y - v) < 5.0 for name, (u, v) in picks.items()}
    mixed = calibrate(images, [picks, picks], markers, lambda _: regions).colors
    apart = calibrate(images, [picks, picks], markers, lambda _: regions, CAMERAS).colors

    def width(colors: Any) -> float:
        return float(np.median([part.sigma[:2] for color in colors.markers.values() for part in color.components]))

    assert width(mixed) > 1.5 * width(apart)
    tables = camera_tables(apart, list(markers), CAMERAS)
    for image, camera in zip(images, CAMERAS, strict=True):
        assert set(MarkerDetector(markers, tables[camera], 640, 480).detect(image)) == set(picks), camera
