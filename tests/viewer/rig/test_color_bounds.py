"""Sliders of a colour's bounds show what a camera says and ask for what they show."""

from __future__ import annotations

import re
from typing import Any

import pytest

from rhot_capture.settings import ColorBounds
from rhot_viewer.panels.cameras import BoundsSliders, bounds_html, change_to, sliders_of


def settings(hue_deg: tuple[float, float], in_force: bool = True) -> dict[str, Any]:
    bounds = ColorBounds(hue_deg=hue_deg, saturation=(0.3, 0.9), value=(0.2, 1.0), in_force=in_force)
    return {"bounds": {"index": bounds.model_dump(mode="json")}}


@pytest.mark.parametrize(
    ("hue_deg", "shown"),
    [
        ((100, 140), (100, 140)),
        ((340, 20), (-20, 20)),
        ((200, 100), (-160, 100)),
        ((0, 360), (0, 360)),
        ((20, 10), (-340 + 360, 360)),
    ],
)
def test_hues_are_one_stretch_also_through_red(hue_deg: tuple[float, float], shown: tuple[float, float]) -> None:
    where = sliders_of(settings(hue_deg), "index")
    assert where == BoundsSliders(shown, (0.3, 0.9), (0.2, 1.0), True)


@pytest.mark.parametrize("hue_deg", [(100, 140), (340, 20), (200, 100), (0, 360), (300, 359)])
def test_what_is_asked_for_is_what_was_shown(hue_deg: tuple[float, float]) -> None:
    before = settings(hue_deg)
    where = sliders_of(before, "index")
    assert where is not None
    asked = change_to("index", where)["bounds"]["index"]
    assert ColorBounds.model_validate(asked) == ColorBounds.model_validate(before["bounds"]["index"])


def test_the_numbers_are_told_beside_the_colours_between_them() -> None:
    text = bounds_html(BoundsSliders((-20.0, 20.0), (0.5, 1.0), (0.0, 1.0), False))
    assert "hue -20 to 20°, saturation 0.50 to 1.00, value 0.00 to 1.00" in text
    assert re.findall(r"rgb\([^)]*\)", text)[::2] == ["rgb(0, 0, 0)", "rgb(128, 32, 32)", "rgb(255, 85, 0)"]


def test_without_bounds_there_is_nothing_to_move() -> None:
    strange: dict[str, Any]
    for strange in ({}, {"bounds": {}}, {"bounds": {"index": {"hue_deg": 3}}}, {"bounds": None}):
        assert sliders_of(strange, "index") is None
