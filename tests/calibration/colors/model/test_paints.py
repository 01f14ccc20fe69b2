from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from rhot.rig.colors import ColorComponent, ColorsFile, GaussianColor, RgbColor
from rhot_calibration.colors.calibration import calibrate
from rhot_calibration.colors.model.fit import ClassPixels
from rhot_calibration.colors.model.paints import PAINTS, Illumination, estimate_illumination, suggest

NONE = np.empty((0, 3))
WHITE = Illumination((1.0, 1.0, 1.0), 1.0, "test")


def color(rgb: RgbColor) -> GaussianColor:
    return GaussianColor(components=(ColorComponent(rgb=rgb, sigma=(0.08, 0.08, 0.3)),))


def pixels(others: Any, skin: Any = NONE, paint: RgbColor = (200, 40, 40)) -> ClassPixels:
    return ClassPixels({"ring": np.full((50, 3), paint, float)}, skin, others, {"ring": 50.0}, len(others), 1)


def test_white_light_leaves_a_colour_alone() -> None:
    assert WHITE.seen((200, 60, 90)) == pytest.approx((200, 60, 90), abs=0.5)


def test_less_saturation_moves_a_colour_towards_the_tint_of_grey() -> None:
    tinted = Illumination((1.2, 1.0, 0.8), 0.001, "test").seen((120, 60, 90))
    assert tinted[0] / tinted[1] == pytest.approx(1.2, rel=0.06)
    assert tinted[2] / tinted[1] == pytest.approx(0.8, rel=0.06)


def test_the_tint_is_read_from_grey_surroundings_and_the_exposure_from_skin() -> None:
    rng = np.random.default_rng(0)
    grey = rng.uniform(60, 160, (2_000, 1)) * (1.15, 1.0, 0.85) + rng.normal(0, 2, (2_000, 3))
    skin = np.full((100, 3), (205, 168, 132)) * (1.15, 1.0, 0.85) * 0.7
    light = estimate_illumination(pixels(grey, skin))
    assert light.gains[0] / light.gains[1] == pytest.approx(1.15, rel=0.02)
    assert light.gains[2] / light.gains[1] == pytest.approx(0.85, rel=0.02)
    assert light.gains[1] == pytest.approx(0.7, rel=0.05)
    assert light.source == "grey surroundings and skin"


def test_without_grey_skin_counts_and_without_either_light_is_white() -> None:
    green_cloth = np.full((2_000, 3), (20.0, 120.0, 30.0))
    skin = np.full((100, 3), (205.0, 168.0, 132.0)) * (0.9, 1.0, 1.1)
    light = estimate_illumination(pixels(green_cloth, skin))
    assert light.source == "skin"
    assert light.gains == pytest.approx((0.9, 1.0, 1.1), rel=0.05)
    assert estimate_illumination(pixels(green_cloth)).gains == (1.0, 1.0, 1.0)


def test_the_suggested_paint_is_far_from_everything_else() -> None:
    colors = ColorsFile(
        markers={"ring": color((40, 60, 200)), "index": color((50, 66, 205)), "thumb": color((30, 120, 60))},
        skin=color((215, 170, 140)),
        background=color((30, 30, 32)),
    )
    found = suggest(colors, "ring", "index", WHITE)
    assert found is not None
    assert found.marker in {"ring", "index"}
    assert found.distance > 10.0 * found.present
    red, green, blue = PAINTS[found.paint]
    assert not (blue > red and blue > green), "no third blue"
    other = suggest(colors, "ring", "index", WHITE, [found.paint])
    assert other is not None
    assert other.paint != found.paint


def test_no_suggestion_where_nothing_is_better() -> None:
    colors = ColorsFile(markers={"ring": color((40, 60, 200))})
    assert suggest(colors, "ring", "background", WHITE) is None


def test_a_suggested_paint_ends_the_confusion(scene: Any, shape: Any, markers: Any) -> None:
    def painted(paint: RgbColor) -> Any:
        shapes = [shape("ring", 100, 100), shape("index", 200, 100, paint=paint), shape("thumb", 300, 100)]
        drawn = scene(shapes, noise=2.0, size=(400, 200))
        return calibrate([drawn.image], [{name: (u, v) for name, (u, v, _) in drawn.truth.items()}], markers)

    before = painted((46, 65, 203))
    assert before.separability.confusable()
    found = suggest(before.colors, "index", "ring", estimate_illumination(before.pixels))
    assert found is not None
    after = painted(found.rgb)
    assert not after.separability.confusable()
