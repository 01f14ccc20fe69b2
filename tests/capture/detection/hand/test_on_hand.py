"""Blobs of a fingertip's colour that are not on the hand: a cuff behind the wrist, and things apart from its skin."""

from __future__ import annotations

import math

import cv2
import numpy as np
import pytest
from painted_shapes import CLOTH, PAINTS, SKIN

from rhot.arrays import ImageArray
from rhot.rig import MarkerConfig
from rhot.rig.colors import ColorComponent, ColorsFile, GaussianColor, RgbColor
from rhot_capture.detection.color_table import ColorTable, build_color_table
from rhot_capture.detection.detector import MarkerDetector

MIDDLE = (180.0, 130.0)
TIPS = {"thumb": (-50.0, -10.0), "index": (-30.0, -60.0), "middle": (0.0, -70.0), "ring": (25.0, -62.0)}
"""Fingertips about the patch of a hand that points up."""
BEHIND = (-10.0, 60.0)
APART = (110.0, -90.0)


def one(rgb: RgbColor) -> GaussianColor:
    return GaussianColor(components=(ColorComponent(rgb=rgb, sigma=(0.07, 0.07, 0.25)),))


def table_of(*, skin: bool = True) -> ColorTable:
    colors = ColorsFile(
        markers={name: one(rgb) for name, rgb in PAINTS.items()},
        skin=one(SKIN) if skin else None,
        background=one(CLOTH),
    )
    return build_color_table(colors, list(PAINTS))


def picture(
    hidden: tuple[str, ...] = (),
    *,
    false: tuple[float, float] | None = None,
    turned_deg: float = 0.0,
    on_skin: bool = True,
) -> ImageArray:
    """A hand of fingertips on skin and a patch, and a thumb's colour elsewhere."""
    image: ImageArray = np.empty((260, 360, 3), np.uint8)
    image[:] = CLOTH[::-1]
    c, s = math.cos(math.radians(turned_deg)), math.sin(math.radians(turned_deg))

    def at(x: float, y: float) -> tuple[int, int]:
        return round(MIDDLE[0] + c * x - s * y), round(MIDDLE[1] + s * x + c * y)

    corners = [at(x, y) for x, y in ((-17, -12), (17, -12), (17, 12), (-17, 12))]
    if on_skin:
        cv2.circle(image, at(0.0, 0.0), 40, SKIN[::-1], cv2.FILLED)
    cv2.fillConvexPoly(image, np.array(corners, np.int32), PAINTS["base"][::-1])
    for name, (x, y) in TIPS.items():
        if name not in hidden:
            if on_skin:
                cv2.line(image, at(x, y), at(0.6 * x, 0.6 * y), SKIN[::-1], 14)
            cv2.circle(image, at(x, y), 7, PAINTS[name][::-1], cv2.FILLED)
    if false is not None:
        cv2.circle(image, at(*false), 9, PAINTS["thumb"][::-1], cv2.FILLED)
    noise = np.random.default_rng(1).normal(0.0, 2.0, image.shape)
    return np.clip(cv2.GaussianBlur(image, (0, 0), 0.9) + noise, 0, 255).astype(np.uint8)


@pytest.fixture
def detector(markers: dict[str, MarkerConfig]) -> MarkerDetector:
    return MarkerDetector(markers, table_of(), 360, 260)


def is_near(found: object, place: tuple[float, float]) -> bool:
    u, v = found.u, found.v  # type: ignore[attr-defined]
    return math.hypot(u - MIDDLE[0] - place[0], v - MIDDLE[1] - place[1]) < 10.0


def test_a_cuff_is_not_taken_for_a_hidden_thumb(detector: MarkerDetector) -> None:
    assert set(detector.detect(picture())) == {*TIPS, "base"}
    for _ in range(40):
        found = detector.detect(picture(("thumb",), false=BEHIND))
        assert "thumb" not in found
    assert any(
        name == "thumb" and getattr(one, "reason", "") == "behind the wrist" for name, one in detector.decisions.judged
    )


def test_a_cuff_is_refused_while_the_hand_turns_with_few_fingertips_in_view(detector: MarkerDetector) -> None:
    detector.detect(picture())
    for turned_deg in range(0, 181, 9):
        image = picture(("thumb", "index", "middle"), false=BEHIND, turned_deg=turned_deg)
        assert "thumb" not in detector.detect(image), turned_deg


def test_a_thumb_beside_its_patch_stays_a_thumb(detector: MarkerDetector) -> None:
    detector.detect(picture())
    for back in (0.0, 8.0, 16.0):
        image = picture(("thumb",), false=(-38.0, back))
        assert is_near(detector.detect(image)["thumb"], (-38.0, back))


@pytest.mark.parametrize("place", [APART, BEHIND])
def test_a_thumb_that_comes_back_is_found_beside_a_thing_of_its_colour(
    detector: MarkerDetector, place: tuple[float, float]
) -> None:
    detector.detect(picture())
    for _ in range(20):
        detector.detect(picture(("thumb",), false=place))
    assert is_near(detector.detect(picture(false=place))["thumb"], TIPS["thumb"])


def test_a_thing_apart_from_the_hand_is_no_fingertip(detector: MarkerDetector) -> None:
    detector.detect(picture())
    assert "thumb" not in detector.detect(picture(("thumb",), false=APART))


def test_a_fingertip_that_hides_its_own_skin_is_kept(detector: MarkerDetector) -> None:
    detector.detect(picture())
    for _ in range(3):
        image = picture(("thumb",), false=TIPS["thumb"])
        assert is_near(detector.detect(image)["thumb"], TIPS["thumb"])


def test_the_fingertips_of_a_glove_are_found(detector: MarkerDetector) -> None:
    for _ in range(3):
        assert set(detector.detect(picture(on_skin=False))) == {*TIPS, "base"}


def test_where_the_colour_of_skin_is_not_known_nothing_is_refused_for_it(markers: dict[str, MarkerConfig]) -> None:
    found = MarkerDetector(markers, table_of(skin=False), 360, 260).detect(picture(false=None))
    assert set(found) == {*TIPS, "base"}
    assert all(one.skin_side is None for one in found.values())


def test_skin_adjoins_where_the_finger_comes_from(detector: MarkerDetector) -> None:
    found = detector.detect(picture())
    for name, (x, y) in TIPS.items():
        assert found[name].skin_side is not None
        side = np.array(found[name].skin_side)
        assert 0.15 < np.hypot(*side) < 0.4
        assert side @ -np.array([x, y]) > 0.95 * np.hypot(*side) * np.hypot(x, y)
    assert found["base"].skin_side is not None
    assert np.hypot(*found["base"].skin_side) < 0.05
