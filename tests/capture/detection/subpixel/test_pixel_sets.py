from __future__ import annotations

from collections.abc import Callable
from typing import Any

import cv2
import numpy as np
import pytest

from rhot_capture.detection.subpixel.pixel_sets import (
    bits_of,
    grown_by_cross,
    grown_by_square,
    pixels_of,
    shrunk_by_cross,
    shrunk_by_square,
)

SHAPE = (21, 26)
KERNELS = {"cross": cv2.getStructuringElement(cv2.MORPH_CROSS, (3, 3)), "square": np.ones((3, 3), np.uint8)}


@pytest.fixture(params=range(5))
def pixels(request: pytest.FixtureRequest) -> Any:
    """Random pixels with a gap at the end of each row and of the picture."""
    pixels = np.zeros(SHAPE, np.uint8)
    pixels[1:-2, 1:-2] = np.random.default_rng(request.param).random((SHAPE[0] - 3, SHAPE[1] - 3)) < 0.6
    return pixels


def test_there_and_back_is_the_same(pixels: Any) -> None:
    assert np.array_equal(pixels_of(bits_of(pixels), pixels.size).reshape(SHAPE), pixels)
    assert bits_of(pixels).bit_count() == np.count_nonzero(pixels)


@pytest.mark.parametrize(("kernel", "grown"), [("cross", grown_by_cross), ("square", grown_by_square)])
def test_grown_is_dilated(pixels: Any, kernel: str, grown: Callable[[int, int], int]) -> None:
    bits = grown(bits_of(pixels), SHAPE[1])
    assert np.array_equal(pixels_of(bits, pixels.size).reshape(SHAPE), cv2.dilate(pixels, KERNELS[kernel]))


@pytest.mark.parametrize(("kernel", "shrunk"), [("cross", shrunk_by_cross), ("square", shrunk_by_square)])
def test_shrunk_is_eroded(pixels: Any, kernel: str, shrunk: Callable[[int, int], int]) -> None:
    bits = shrunk(bits_of(pixels), SHAPE[1])
    eroded = cv2.erode(pixels, KERNELS[kernel], borderType=cv2.BORDER_CONSTANT, borderValue=0)
    assert np.array_equal(pixels_of(bits, pixels.size).reshape(SHAPE), eroded)
