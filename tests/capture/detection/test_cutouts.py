from __future__ import annotations

from dataclasses import replace
from typing import Any

import cv2
import numpy as np
import pytest

from rhot.geometry.hull import Region
from rhot_capture.detection.color_table import ColorTable
from rhot_capture.detection.cutouts import Cutouts


@pytest.fixture
def image(scene: Any, shape: Any) -> Any:
    return scene([shape("ring", 100, 80), shape("index", 300, 200), shape("thumb", 318, 200)], size=(400, 300)).image


def test_parts_are_labelled_as_they_are_in_the_whole_picture(image: Any, table: ColorTable) -> None:
    in_whole, _ = table.classify(image)
    looks = [(4, Region(70, 50, 130, 120)), (2, Region(270, 170, 350, 230)), (1, Region(270, 170, 350, 230))]
    parts = Cutouts(image, table, looks)
    for (label, region), place in zip(looks, parts.parts, strict=True):
        assert (place.label, place.region) == (label, region)
        width, height = region.right - region.left, region.bottom - region.top
        labels = parts.labels[place.row : place.row + height, :width]
        expected = in_whole[region.top : region.bottom, region.left : region.right]
        assert np.array_equal(labels, expected)
        own = parts.own[place.row : place.row + height, :width]
        majority = cv2.medianBlur((labels == label).astype(np.uint8), 3)
        assert np.array_equal(own[1:-1, 1:-1], majority[1:-1, 1:-1])
        assert own.any()


@pytest.mark.parametrize("black_is", ["nobody's", "paint", "faint paint"])
def test_nothing_is_found_between_the_parts(image: Any, table: ColorTable, black_is: str) -> None:
    labels, faint = table.labels.copy(), table.faint.copy()
    labels[0] = 4 if black_is == "paint" else 0
    faint[0] = 0 if black_is == "nobody's" else 4
    looks = [(4, Region(70, 50, 130, 120)), (2, Region(270, 170, 390, 230))]
    parts = Cutouts(image, replace(table, labels=labels, faint=faint), looks, faint=black_is == "faint paint")
    first, second = (place.row for place in parts.parts)
    assert not parts.own[first + 70 : second].any(), "between the first and the second"
    assert not parts.own[first : first + 70, 61:].any(), "beside the first, which is narrower"


def test_single_wrong_pixels_go(table: ColorTable, paints: Any) -> None:
    image = np.full((40, 40, 3), 30, np.uint8)
    image[10, 10] = paints["ring"][::-1]
    image[20:23, 20:23] = paints["ring"][::-1]
    cutouts = Cutouts(image, table, [(4, Region(0, 0, 40, 40))])
    own = cutouts.own[cutouts.parts[0].row :]
    assert own[10, 10] == 0
    assert own[21, 21] == 1
    assert not own[:, 40:].any()
