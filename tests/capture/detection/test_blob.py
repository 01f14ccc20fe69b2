from __future__ import annotations

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from rhot.arrays import ImageArray
from rhot_capture.detection.blob import PADDING_PX, find_blobs, pixel_area


def ellipse(labels: ImageArray, centre: tuple[int, int], axes: tuple[int, int], label: int) -> None:
    cv2.ellipse(labels, centre, axes, 0, 0, 360, label, cv2.FILLED)


@pytest.fixture
def labels() -> ImageArray:
    return np.zeros((120, 160), np.uint8)


@given(st.integers(3, 20), st.integers(3, 20), st.floats(0.0, 180.0))
@settings(deadline=None, max_examples=40)
def test_outline_counts_its_pixels(long: int, short: int, turn: float) -> None:
    mask = np.zeros((64, 64), np.uint8)
    cv2.ellipse(mask, (32, 32), (long, short), turn, 0, 360, 255, cv2.FILLED)
    contours, _ = cv2.findContours(mask, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
    assert pixel_area(np.asarray(contours[0], dtype=np.int32)) == pytest.approx(cv2.countNonZero(mask))


def test_only_the_asked_label_counts(labels: ImageArray) -> None:
    ellipse(labels, (40, 40), (8, 10), 1)
    ellipse(labels, (52, 40), (8, 10), 2)
    (blob,) = find_blobs(labels, 2, 12, 4000)
    assert blob.area == np.count_nonzero(labels == 2)
    assert blob.rim[:, 0].min() == np.nonzero(labels == 2)[1].min()


def test_size_gate_is_on_the_area(labels: ImageArray) -> None:
    ellipse(labels, (40, 40), (3, 3), 1)
    ellipse(labels, (100, 60), (20, 20), 1)
    areas = [blob.area for blob in find_blobs(labels, 1, 12, 4000)]
    assert areas == sorted(areas, reverse=True)
    assert len(areas) == 2
    assert [blob.area for blob in find_blobs(labels, 1, 100, 4000)] == areas[:1]
    assert [blob.area for blob in find_blobs(labels, 1, 12, 100)] == areas[1:]


def test_marker_split_by_a_highlight_is_one_blob(labels: ImageArray) -> None:
    ellipse(labels, (60, 60), (12, 16), 1)
    whole = np.count_nonzero(labels)
    labels[59:61] = 0
    (blob,) = find_blobs(labels, 1, 12, 4000)
    assert len(blob.contours) == 2
    assert blob.area == pytest.approx(whole, rel=0.03)


def test_two_markers_apart_stay_two(labels: ImageArray) -> None:
    ellipse(labels, (40, 60), (8, 8), 1)
    ellipse(labels, (75, 60), (8, 8), 1)
    assert len(find_blobs(labels, 1, 12, 4000)) == 2


def test_shine_is_filled(labels: ImageArray) -> None:
    ellipse(labels, (60, 60), (12, 16), 1)
    whole = np.count_nonzero(labels)
    ellipse(labels, (60, 55), (3, 3), 0)
    (blob,) = find_blobs(labels, 1, 12, 4000)
    assert blob.area == whole


def test_window_stays_inside_the_image_and_border_is_noticed(labels: ImageArray) -> None:
    ellipse(labels, (0, 0), (12, 12), 1)
    ellipse(labels, (100, 60), (12, 12), 1)
    inner, corner = sorted(find_blobs(labels, 1, 12, 4000), key=lambda blob: -blob.x0)
    assert (corner.x0, corner.y0) == (0, 0)
    assert corner.border_share > 0.3
    assert inner.border_share == 0.0
    assert inner.x0 == 100 - 12 - PADDING_PX
    assert labels[inner.window].shape == inner.mask.shape


def test_solidity_distinguishes_a_disc_from_a_crescent(labels: ImageArray) -> None:
    ellipse(labels, (40, 60), (20, 20), 1)
    ellipse(labels, (48, 60), (20, 20), 0)
    ellipse(labels, (110, 60), (20, 20), 1)
    disc, crescent = find_blobs(labels, 1, 12, 4000)
    assert disc.solidity > 0.95
    assert crescent.solidity < 0.6


def test_a_frame_full_of_noise_gives_a_bounded_number_of_blobs() -> None:
    labels = (np.random.default_rng(1).random((480, 640)) < 0.3).astype(np.uint8)
    assert len(find_blobs(labels, 1, 12, 4000)) <= 6
