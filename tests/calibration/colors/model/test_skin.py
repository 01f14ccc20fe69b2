from __future__ import annotations

import cv2
import numpy as np
import pytest

from rhot.arrays import BoolArray, ImageArray
from rhot.rig.colors import RgbColor, log_ratio
from rhot_calibration.colors.calibration import are_skin
from rhot_calibration.colors.model.fit import COUNTER_FLOOR, fit_mixture

PLACES = ((150, 60), (180, 50), (210, 55), (240, 80), (120, 130), (190, 160))
WOOD: RgbColor = (150.0, 125.0, 105.0)
CLOTH: RgbColor = (50.0, 52.0, 56.0)
LIGHT_SKIN: RgbColor = (205.0, 165.0, 140.0)
DARK_SKIN: RgbColor = (72.0, 50.0, 40.0)


def picture(skin: RgbColor, desk: RgbColor) -> tuple[ImageArray, dict[str, BoolArray]]:
    """A hand on a desk: fingers, palm and forearm, and the pixels of its markers."""
    rng = np.random.default_rng(1)
    image: ImageArray = np.empty((300, 400, 3), np.uint8)
    image[:] = desk
    for place in PLACES[:5]:
        cv2.line(image, place, (185, 180), skin, 18)
    cv2.circle(image, (185, 170), 40, skin, cv2.FILLED)
    cv2.line(image, (185, 170), (185, 300), skin, 50)
    found = {}
    for number, place in enumerate(PLACES):
        mask: ImageArray = np.zeros(image.shape[:2], np.uint8)
        cv2.circle(mask, place, 8, 1, cv2.FILLED)
        found[str(number)] = mask > 0
        image[mask > 0] = (40, 60, 200)
    shade = np.linspace(0.85, 1.1, image.shape[1])[None, :, None]
    return np.clip(image * shade + rng.normal(0.0, 3.0, image.shape), 0, 255).astype(np.uint8), found


def nearest_is_skin(rgb: RgbColor, skin: RgbColor, desk: RgbColor, *, markers: int = 6) -> bool:
    """Whether the component nearest to a colour is taken for skin."""
    image, found = picture(skin, desk)
    features = log_ratio(image.astype(np.float64))
    free = ~np.any(list(found.values()), axis=0)
    components = fit_mixture(features[free], 8, COUNTER_FLOOR)
    told = are_skin(components, [features], [dict(list(found.items())[:markers])])
    away = [np.linalg.norm(component.mean() - log_ratio(np.array(rgb))) for component in components]
    return told[int(np.argmin(away))]


@pytest.mark.parametrize(
    ("skin", "desk"), [(LIGHT_SKIN, CLOTH), (LIGHT_SKIN, WOOD), (DARK_SKIN, CLOTH), (DARK_SKIN, WOOD)]
)
def test_the_hand_is_skin_and_the_desk_is_not(skin: RgbColor, desk: RgbColor) -> None:
    assert nearest_is_skin(skin, skin, desk)
    assert not nearest_is_skin(desk, skin, desk)


def test_with_few_markers_the_hue_and_brightness_decide() -> None:
    assert nearest_is_skin(LIGHT_SKIN, LIGHT_SKIN, CLOTH, markers=2)
    assert not nearest_is_skin(CLOTH, LIGHT_SKIN, CLOTH, markers=2)
    assert not nearest_is_skin(DARK_SKIN, DARK_SKIN, CLOTH, markers=2), "as dark as a shadow"


def test_of_no_surroundings_nothing_is_told() -> None:
    assert are_skin([], [], []) == []
