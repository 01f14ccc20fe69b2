"""Saturation, contrast and brightness of simulated pictures."""

from __future__ import annotations

import numpy as np

from rhot_sim.sources.camera import with_picture

IMAGE = np.array([[[40, 60, 200], [128, 127, 128], [90, 90, 90]]], np.uint8)
NEUTRAL = {"saturation": 1.0, "contrast": 1.0, "brightness": 0.0}


def test_a_neutral_picture_is_not_touched() -> None:
    assert with_picture(IMAGE, NEUTRAL) is IMAGE


def test_without_saturation_all_is_grey_and_as_bright() -> None:
    grey = with_picture(IMAGE, {**NEUTRAL, "saturation": 0.0})
    assert (grey == grey[..., :1]).all()
    assert grey[0, :, 0].tolist() == [round(0.114 * 40 + 0.587 * 60 + 0.299 * 200), 127, 90]


def test_contrast_turns_about_the_middle_and_brightness_adds() -> None:
    high = with_picture(IMAGE, {**NEUTRAL, "contrast": 2.0})
    assert high[0].tolist() == [[0, 0, 255], [128, 126, 128], [52, 52, 52]]
    dark = with_picture(IMAGE, {**NEUTRAL, "brightness": -0.2})
    assert dark[0].tolist() == [[0, 9, 149], [77, 76, 77], [39, 39, 39]]


def test_more_saturation_moves_colours_away_from_grey() -> None:
    more = with_picture(IMAGE, {**NEUTRAL, "saturation": 1.3}).astype(int)
    assert np.ptp(more[0, 0]) > np.ptp(IMAGE[0, 0].astype(int))
    assert np.ptp(more[0, 2]) == 0
