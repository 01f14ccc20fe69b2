from __future__ import annotations

from typing import Any

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from rhot_capture.detection.blob import blobs_of, find_blobs
from rhot_capture.detection.candidates import MIN_PLAUSIBILITY, _is_thin, clings, judge
from rhot_capture.detection.color_table import ColorTable
from rhot_capture.detection.cutouts import Cutouts, Region
from rhot_capture.detection.track import MarkerTrack


@given(st.integers(0, 2**31 - 1))
@settings(deadline=None, max_examples=80)
def test_thin_is_what_nothing_is_left_of_without_its_rim(seed: int) -> None:
    rng = np.random.default_rng(seed)
    mask = np.zeros((30, 30), np.uint8)
    for _ in range(int(rng.integers(1, 4))):
        ends = [(int(u), int(v)) for u, v in rng.integers(8, 22, (2, 2))]
        cv2.line(mask, ends[0], ends[1], 1, int(rng.integers(1, 5)))
    for blob in find_blobs(mask, 1, 3, 1e9):
        own = mask[blob.window] & blob.mask
        thin = not cv2.erode(own, np.ones((3, 3), np.uint8), borderValue=0, borderType=cv2.BORDER_CONSTANT).any()
        assert _is_thin(blob, own, cv2.countNonZero(own)) == thin


@pytest.mark.parametrize("away", [0, 12])
def test_what_lies_in_another_marker_hangs_on_it_and_a_marker_apart_does_not(away: int) -> None:
    labels = np.zeros((70, 70), np.uint8)
    labels[20:60, 10:50] = 2
    labels[20 - away : 26 - away, 28:34] = 1
    (blob,) = find_blobs(labels, 1, 12, 4000)
    assert clings(blob, labels[blob.window], 1) == (away == 0)


@pytest.mark.parametrize("room", [1, 3, 8])
def test_a_candidate_is_the_same_however_little_of_its_surroundings_was_cut_out(
    scene: Any, shape: Any, table: ColorTable, room: int
) -> None:
    image = scene([shape("ring", 60, 60, radius=8)], size=(121, 121), noise=3.0).image
    found = []
    for margin in (30, room):
        whole = Region(52 - margin, 49 - margin, 69 + margin, 72 + margin)
        cutouts = Cutouts(image, table, [(4, whole)])
        ((blob,),) = blobs_of(cutouts.own, cutouts.places, [(12.0, 4000.0)], (121, 121))
        candidate = judge(cutouts, blob, 4, 12.0, MarkerTrack(), alone=True)
        assert candidate is not None
        found.append(candidate)
    wide, tight = found
    assert np.array_equal(wide.blob.mask, tight.blob.mask)
    assert (wide.blob.x0, wide.blob.y0) == (tight.blob.x0, tight.blob.y0)
    assert tight.evidence == pytest.approx(wide.evidence)
    assert tight.plausibility == pytest.approx(wide.plausibility)
    assert tight.plausibility >= MIN_PLAUSIBILITY
