from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import cv2
import numpy as np
import pytest
from painted_shapes import CLOTH, PAINTS, SKIN

from rhot.arrays import ImageArray
from rhot.rig import MarkerConfig
from rhot.rig.colors import ColorComponent, ColorsFile, GaussianColor, RgbColor
from rhot_capture.detection.color_table import ColorTable, build_color_table
from rhot_capture.detection.detector import MarkerDetector
from rhot_capture.detection.hand.evidence import HandReach

STRIP = "index"
PLACES = {"thumb": (60, 40), "middle": (85, 36), "little": (110, 40), "base": (85, 100)}
FAR = (300, 200)


def one(rgb: RgbColor) -> GaussianColor:
    return GaussianColor(components=(ColorComponent(rgb=rgb, sigma=(0.07, 0.07, 0.25)),))


def table_of(*, counters: bool = True) -> ColorTable:
    colors = ColorsFile(
        markers={name: one(rgb) for name, rgb in PAINTS.items()},
        skin=one(SKIN) if counters else None,
        background=one(CLOTH) if counters else None,
    )
    return build_color_table(colors, list(PAINTS))


def picture(strip: tuple[int, int] | None, others: int = 4, paint: str = STRIP) -> ImageArray:
    """Markers on skin, and one that shows a strip of three by twelve pixels, blurred."""
    image: ImageArray = np.empty((240, 360, 3), np.uint8)
    image[:] = CLOTH[::-1]
    for name, (u, v) in list(PLACES.items())[:others]:
        cv2.circle(image, (u, v), 12, SKIN[::-1], cv2.FILLED)
        cv2.circle(image, (u, v), 6, PAINTS[name][::-1], cv2.FILLED)
    if strip is not None:
        u, v = strip
        cv2.rectangle(image, (u - 12, v - 3), (u + 12, v + 12), SKIN[::-1], cv2.FILLED)
        cv2.rectangle(image, (u - 6, v - 3), (u + 5, v - 1), PAINTS[paint][::-1], cv2.FILLED)
    noise = np.random.default_rng(1).normal(0.0, 2.0, image.shape)
    return np.clip(cv2.GaussianBlur(image, (0, 0), 0.9) + noise, 0, 255).astype(np.uint8)


def detector(markers: dict[str, MarkerConfig], table: ColorTable) -> MarkerDetector:
    return MarkerDetector(markers, table, 360, 240)


def test_a_strip_of_paint_beside_the_other_markers_is_found_at_its_middle(markers: dict[str, MarkerConfig]) -> None:
    image = picture((50, 70))
    found = detector(markers, table_of()).detect(image)
    assert set(found) == {STRIP, *PLACES}
    assert np.hypot(found[STRIP].u - 49.5, found[STRIP].v - 68.0) < 1.0
    assert 6 < np.count_nonzero(found[STRIP].blob.mask) < found[STRIP].blob.area, "pure paint says what half paint is"
    strict = detector(markers, table_of(counters=False)).detect(image)
    assert STRIP not in strict, "not faint: the test would show nothing"
    assert found[STRIP].score < found["base"].score


@pytest.mark.parametrize(("strip", "others"), [(FAR, 4), ((50, 70), 2), ((50, 70), 0)])
def test_faint_colours_are_rejected_far_from_a_hand_or_without_one(
    markers: dict[str, MarkerConfig], strip: tuple[int, int], others: int
) -> None:
    found = detector(markers, table_of()).detect(picture(strip, others))
    assert STRIP not in found
    assert len(found) == others


def test_a_hand_that_was_open_is_known_when_one_marker_is_left(markers: dict[str, MarkerConfig]) -> None:
    sees = detector(markers, table_of())
    sees.detect(picture(None))
    assert STRIP in sees.detect(picture((50, 70), others=1))
    sees.reset()
    assert STRIP not in sees.detect(picture((50, 70), others=1))


def test_skin_and_mixtures_of_other_paints_are_no_faint_marker(markers: dict[str, MarkerConfig]) -> None:
    assert set(detector(markers, table_of()).detect(picture((50, 70), paint="little"))) == set(PLACES)


def test_markers_farther_apart_than_the_hand_was_wide_leave_nowhere_to_look(markers: dict[str, MarkerConfig]) -> None:
    def at(u: float, v: float) -> Any:
        return SimpleNamespace(blob=SimpleNamespace(middle=(u, v)))

    reach, table, image = HandReach(markers), table_of(), picture((50, 70))
    missing = {STRIP: table.names.index(STRIP) + 1}
    together = {name: at(*place) for name, place in PLACES.items()}
    assert reach.looks(image, table, missing, together)
    assert reach.looks(image, table, missing, {"thumb": at(60, 40), "middle": at(*FAR)}) == []
