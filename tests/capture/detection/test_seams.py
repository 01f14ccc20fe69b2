from __future__ import annotations

import numpy as np
import pytest

from rhot.arrays import ImageArray
from rhot_capture.detection.blob import Blob, find_blobs
from rhot_capture.detection.candidates import is_mixture, neighbour_of

SKIN, CLOTH = (150.0, 180.0, 220.0), (70.0, 65.0, 60.0)
PAINTS = {
    "green": (80.0, 200.0, 80.0),
    "yellow": (60.0, 220.0, 250.0),
    "red": (50.0, 50.0, 220.0),
    "pale green": (120.0, 175.0, 120.0),
}


@pytest.mark.parametrize(
    ("away", "adjacency", "hangs"), [(0, 0.4, True), (6, 0.4, False), (6, 0.1, True), (12, 0.1, False)]
)
def test_a_neighbour_has_the_larger_a_share_of_the_ring_the_deeper_a_blob_lies_in_it(
    away: int, adjacency: float, hangs: bool
) -> None:
    labels = np.zeros((70, 70), np.uint8)
    labels[20:60, 10:50] = 2
    labels[20 - away : 26 - away, 28:34] = 1
    (blob,) = find_blobs(labels, 1, 12, 4000)
    beside = neighbour_of(blob, labels[blob.window], 1)
    assert (beside.share > adjacency) == hangs
    assert beside.pixels == np.count_nonzero(labels[blob.window] == 2)


def picture(strip: tuple[float, ...], patch: str, ground: tuple[float, ...] = SKIN) -> tuple[ImageArray, ImageArray]:
    """A patch of paint (label 2) with a strip beside it (label 1) on skin or cloth, skin elsewhere; and the labels."""
    image = np.empty((60, 60, 3))
    image[:, :28], image[:, 28:] = ground, SKIN
    labels = np.zeros((60, 60), np.uint8)
    image[20:40, 30:42], labels[20:40, 30:42] = PAINTS[patch], 2
    image[18:42, 26:30], labels[18:42, 26:30] = strip, 1
    noisy = image + np.random.default_rng(1).normal(0.0, 4.0, image.shape)
    return np.clip(np.rint(noisy), 0, 255).astype(np.uint8), labels


def mixed(image: ImageArray, labels: ImageArray, label: int) -> bool:
    blob: Blob
    (blob,) = find_blobs(labels, label, 12, 4000)
    return is_mixture(blob, neighbour_of(blob, labels[blob.window], label), image[blob.window])


@pytest.mark.parametrize("patch", PAINTS)
@pytest.mark.parametrize("share", [0.3, 0.5, 0.7])
@pytest.mark.parametrize("ground", [SKIN, CLOTH])
def test_where_paint_mixes_with_its_surroundings_is_a_seam(
    patch: str, share: float, ground: tuple[float, float, float]
) -> None:
    strip = share * np.array(PAINTS[patch]) + (1.0 - share) * np.array(ground)
    image, labels = picture(tuple(strip), patch, ground)
    assert mixed(image, labels, 1)
    assert not mixed(image, labels, 2), "the paint itself"


@pytest.mark.parametrize(
    ("strip", "patch"), [("yellow", "green"), ("red", "green"), ("green", "red"), ("red", "yellow")]
)
def test_paint_beside_other_paint_is_none(strip: str, patch: str) -> None:
    image, labels = picture(PAINTS[strip], patch)
    assert not mixed(image, labels, 1)
    assert not mixed(image, labels, 2)


def test_without_surroundings_no_mixture_is_detected() -> None:
    labels = np.full((20, 20), 2, np.uint8)
    labels[5:15, 5:10] = 1
    assert not mixed(np.full((20, 20, 3), 128, np.uint8), labels, 1)
