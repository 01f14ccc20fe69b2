"""Colours for people."""

from __future__ import annotations

from rhot.rig import Rig, write_json_model
from rhot.rig.colors import ColorComponent, ColorsFile, GaussianColor, HsvRangeColor, RgbBoxColor
from rhot_viewer.browser.camera_layer import marker_colors, screen_color


def test_each_kind_of_colour_keeps_its_hue_and_is_bright() -> None:
    dark_green = ColorComponent(rgb=(10.0, 60.0, 20.0), sigma=(0.1, 0.1, 0.1), weight=0.9)
    rim = ColorComponent(rgb=(60.0, 0.0, 0.0), sigma=(0.1, 0.1, 0.1), weight=0.1)
    red, green, blue = screen_color(GaussianColor(components=(rim, dark_green)))
    assert green >= 190 > max(red, blue)
    assert screen_color(RgbBoxColor(low=(200.0, 0.0, 0.0), high=(240.0, 40.0, 40.0))) == (220, 20, 20)
    red, green, blue = screen_color(HsvRangeColor(hue_deg=(340.0, 20.0)))
    assert red >= 190
    assert abs(green - blue) <= 1, "the middle of 340 to 20 degrees is red"


def test_without_colours_every_marker_has_one_of_its_own(rig: Rig) -> None:
    colors = marker_colors(rig)
    assert set(colors) == set(rig.config.markers)
    assert len(set(colors.values())) == len(colors)


def test_a_wrong_file_is_no_reason_to_show_nothing(rig: Rig) -> None:
    made_up = marker_colors(rig)
    rig.colors_path.write_text("{")
    assert marker_colors(rig) == made_up
    box = RgbBoxColor(low=(250.0, 0.0, 0.0), high=(250.0, 0.0, 0.0))
    write_json_model(rig.colors_path, ColorsFile(markers={"thumb": box, "toe": box}))
    assert marker_colors(rig) == made_up | {"thumb": (250, 0, 0), "left_ring": (250, 0, 0)}, "they share a paint"
