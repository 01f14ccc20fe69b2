from __future__ import annotations

import itertools

import cv2
import numpy as np

from rhot_sim.world.paint import PAINT_SHADES, PAINTS, SKIN, paints_of, shaded


def test_names_have_their_paint_and_others_get_a_free_one() -> None:
    names = [*PAINTS, *(f"left_{name}" for name in PAINTS)]
    paints = paints_of(names)
    assert paints["index"] == PAINTS["index"]
    assert len(set(paints.values())) == 12


def test_paints_are_far_apart_in_hue_or_brightness() -> None:
    colors = [*PAINTS.values(), SKIN]
    lab = cv2.cvtColor(np.array([colors], dtype=np.float32) / 255.0, cv2.COLOR_BGR2LAB)[0]
    distances = [np.linalg.norm(a - b) for a, b in itertools.combinations(lab, 2)]
    # CIE 1976 difference; 2.3 is just noticeable.
    assert min(distances) > 30.0


def test_colors_of_a_marker_stay_in_range() -> None:
    for paint in PAINTS.values():
        for _, brightness in PAINT_SHADES:
            assert all(0.0 <= channel <= 255.0 for channel in shaded(paint, brightness))
    assert shaded((200.0, 100.0, 0.0), 2.0) == (255.0, 200.0, 0.0)
