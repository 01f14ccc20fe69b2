from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from rhot_bench.thesis.capture import REGION_MARGIN_PX, RgbBox, ThesisDetector, rgb_boxes

RED, BLUE = (20, 30, 220), (220, 60, 30)
BOXES = {"red": RgbBox((0, 0, 150), (90, 90, 255)), "blue": RgbBox((150, 0, 0), (255, 120, 90))}


def picture(**squares: tuple[int, int]) -> NDArray[np.uint8]:
    """Squares of 21 px about (u, v) on black."""
    image = np.zeros((480, 640, 3), np.uint8)
    for name, (u, v) in squares.items():
        image[max(0, v - 10) : v + 11, max(0, u - 10) : u + 11] = RED if name == "red" else BLUE
    return image


@pytest.mark.parametrize("place", [(100, 200), (400, 77), (611, 450)])
def test_kernels_of_even_size_shift_every_centre_by_two_pixels(place: tuple[int, int]) -> None:
    found = ThesisDetector(BOXES).detect(picture(red=place))
    assert set(found) == {"red"}
    np.testing.assert_allclose(np.array(found["red"]) - place, (2.0, 2.0), atol=0.5)


def test_a_marker_is_followed_within_its_region_only() -> None:
    detector = ThesisDetector(BOXES)
    detector.detect(picture(red=(100, 100), blue=(300, 300)))
    near = detector.detect(picture(red=(100 + REGION_MARGIN_PX - 15, 100), blue=(300, 300)))
    np.testing.assert_allclose(near["red"], (127, 102), atol=0.6)
    assert "red" not in detector.detect(picture(red=(400, 400), blue=(300, 300)))
    again = detector.detect(picture(red=(400, 400), blue=(300, 300)))
    np.testing.assert_allclose(again["red"], (402, 402), atol=0.6)


def test_reset_searches_the_whole_picture() -> None:
    detector = ThesisDetector(BOXES)
    detector.detect(picture(red=(100, 100)))
    detector.reset()
    np.testing.assert_allclose(detector.detect(picture(red=(500, 400)))["red"], (502, 402), atol=0.6)


def test_the_largest_of_a_colour_wins_at_the_border_too() -> None:
    image = picture(red=(320, 240))
    image[2:9, 2:9] = RED
    detector = ThesisDetector(BOXES)
    np.testing.assert_allclose(detector.detect(image)["red"], (322, 242), atol=0.6)
    detector.reset()
    assert "red" in detector.detect(picture(red=(0, 0)))


def test_thresholds_hold_the_paint_and_nothing_else() -> None:
    rng = np.random.default_rng(0)
    paint = np.clip(rng.normal(RED, 5.0, (500, 3)), 0, 255).astype(np.uint8)
    others = np.array([[20, 30, 190], [0, 0, 0]], np.uint8)
    box = rgb_boxes({"red": paint}, others)["red"]
    inside = ((paint >= box.low) & (paint <= box.high)).all(axis=1)
    assert inside.mean() > 0.85
    assert not ((others >= box.low) & (others <= box.high)).all(axis=1).any()
