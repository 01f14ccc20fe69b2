from __future__ import annotations

import time

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from rhot.errors import ConfigError
from rhot.rig.colors import (
    ColorComponent,
    ColorsFile,
    GaussianColor,
    HsvRangeColor,
    RgbBoxColor,
    RgbColor,
    nominal_colors,
)
from rhot_capture.detection.color_table import TABLE_SIZE, ColorTable, build_color_table, camera_tables, table_colors

byte = st.integers(min_value=0, max_value=255)


def label_of(table: ColorTable, rgb: RgbColor) -> str:
    image = np.array([[rgb[::-1]]]).astype(np.uint8)
    label = int(table.classify(image)[0][0, 0])
    return table.names[label - 1] if label else ""


@given(byte, byte, byte)
@settings(deadline=None, max_examples=100)
def test_every_colour_falls_into_the_cell_that_the_table_means(red: int, green: int, blue: int) -> None:
    image = np.array([[(blue, green, red)]], np.uint8)
    index = int(np.asarray(cv2.cvtColor(image, cv2.COLOR_BGR2BGR565)).view(np.uint16)[0, 0, 0])
    middle = table_colors()[index]
    assert np.all(np.abs(middle - (red, green, blue)) <= (3.5, 1.5, 3.5))


def test_paints_are_recognised_in_more_and_less_light(table: ColorTable, paints: dict[str, RgbColor]) -> None:
    for name, rgb in paints.items():
        for light in (0.75, 1.0):
            red, green, blue = (light * channel for channel in rgb)
            assert label_of(table, (red, green, blue)) == name


@pytest.mark.parametrize("rgb", [(30, 30, 32), (215, 170, 140), (255, 255, 255), (128, 128, 128), (0, 0, 0)])
def test_unknown_colours_get_no_label(table: ColorTable, rgb: RgbColor) -> None:
    assert label_of(table, rgb) == ""


def test_likelihood_is_highest_at_the_centre_and_zero_outside(table: ColorTable) -> None:
    assert np.all(table.likelihoods[table.labels == 0] == 0)
    for label, name in enumerate(table.names, start=1):
        assert table.likelihoods[table.labels == label].max() >= 200, name


def test_counter_classes_win_where_they_are_more_likely() -> None:
    paint = ColorComponent(rgb=(200, 60, 60), sigma=(0.2, 0.2, 0.4))
    skin = ColorComponent(rgb=(180, 90, 80), sigma=(0.08, 0.08, 0.4))
    alone = ColorsFile(markers={"thumb": GaussianColor(components=(paint,))})
    against = alone.model_copy(update={"skin": GaussianColor(components=(skin,))})
    assert label_of(build_color_table(alone, ["thumb"]), (180, 90, 80)) == "thumb"
    assert label_of(build_color_table(against, ["thumb"]), (180, 90, 80)) == ""
    assert label_of(build_color_table(against, ["thumb"]), (200, 60, 60)) == "thumb"


def test_skin_is_as_likely_as_a_paint_whatever_its_share_of_the_pictures() -> None:
    paint = ColorComponent(rgb=(200, 60, 60), sigma=(0.08, 0.08, 0.3))
    colors = ColorsFile(markers={"thumb": GaussianColor(components=(paint,))})

    def table(weight: float) -> ColorTable:
        skin = ColorComponent(rgb=(180, 90, 80), sigma=(0.08, 0.08, 0.3), weight=weight)
        return build_color_table(colors.model_copy(update={"skin": GaussianColor(components=(skin,))}), ["thumb"])

    assert np.array_equal(table(1.0).labels, table(0.05).labels)


def test_a_camera_sees_the_colours_by_its_factors_but_boxes_as_they_are() -> None:
    colors = nominal_colors({"thumb": (100, 60, 40)}).model_copy(update={"gains": {"left": (0.5, 1.0, 1.6)}})
    tables = camera_tables(colors, ["thumb"], ["left", "right", "top"])
    assert label_of(tables["left"], (200, 60, 25)) == "thumb"
    assert label_of(tables["right"], (200, 60, 25)) == ""
    assert label_of(tables["right"], (100, 60, 40)) == "thumb"
    assert tables["right"] is tables["top"]
    box = colors.model_copy(update={"markers": {"thumb": RgbBoxColor(low=(190, 50, 15), high=(210, 70, 35))}})
    assert label_of(build_color_table(box, ["thumb"], "left"), (200, 60, 25)) == "thumb"


def test_marker_without_a_colour_is_never_labelled() -> None:
    table = build_color_table(nominal_colors({"thumb": (30, 120, 60)}), ["thumb", "base"])
    assert not np.any(table.labels == 2)


def test_box_takes_exactly_its_colours_to_within_a_cell() -> None:
    table = build_color_table(
        ColorsFile(markers={"thumb": RgbBoxColor(low=(100, 0, 0), high=(140, 60, 60))}), ["thumb"]
    )
    assert label_of(table, (100, 0, 0)) == "thumb"
    assert label_of(table, (140, 60, 60)) == "thumb"
    assert label_of(table, (90, 30, 30)) == ""
    assert label_of(table, (120, 70, 30)) == ""


def test_narrow_box_still_catches_its_colour() -> None:
    table = build_color_table(ColorsFile(markers={"a": RgbBoxColor(low=(0, 0, 254), high=(36, 146, 255))}), ["a"])
    assert label_of(table, (10, 100, 255)) == "a"


def test_a_box_goes_before_statistics() -> None:
    colors = ColorsFile(
        markers={
            "a": GaussianColor(components=(ColorComponent(rgb=(200, 60, 60), sigma=(0.3, 0.3, 0.5)),)),
            "b": RgbBoxColor(low=(190, 50, 50), high=(210, 70, 70)),
        }
    )
    table = build_color_table(colors, ["a", "b"])
    assert label_of(table, (200, 60, 60)) == "b"
    assert label_of(table, (230, 60, 60)) == "a"


def test_hue_range_passes_through_red() -> None:
    table = build_color_table(ColorsFile(markers={"a": HsvRangeColor(hue_deg=(340, 20))}), ["a"])
    assert label_of(table, (250, 20, 20)) == "a"
    assert label_of(table, (250, 20, 60)) == "a"
    assert label_of(table, (20, 250, 20)) == ""
    assert label_of(table, (250, 230, 230)) == ""


@given(st.floats(min_value=0.2, max_value=2.0), st.floats(min_value=1.05, max_value=3.0))
@settings(deadline=None, max_examples=15)
def test_more_tolerance_never_loses_a_colour(tolerance: float, factor: float) -> None:
    colors = ColorsFile(
        markers={
            "a": GaussianColor(components=(ColorComponent(rgb=(30, 160, 60), sigma=(0.1, 0.1, 0.3)),)),
            "b": RgbBoxColor(low=(180, 0, 0), high=(220, 60, 60)),
        }
    )
    narrow = build_color_table(colors.with_tolerances({"a": tolerance, "b": tolerance}), ["a", "b"]).labels
    wide = build_color_table(
        colors.with_tolerances({"a": tolerance * factor, "b": tolerance * factor}), ["a", "b"]
    ).labels
    assert np.count_nonzero(narrow) <= np.count_nonzero(wide)
    assert np.all(wide[narrow > 0] > 0)


def test_building_takes_less_than_a_third_of_a_second(paints: dict[str, RgbColor]) -> None:
    component = ColorComponent(rgb=(90, 80, 70), sigma=(0.1, 0.1, 0.3), weight=0.1)
    colors = nominal_colors(paints).model_copy(update={"background": GaussianColor(components=(component,) * 20)})
    times = []
    for _ in range(3):
        begun = time.process_time()  # others may have the processors
        build_color_table(colors, list(paints))
        times.append(time.process_time() - begun)
    assert min(times) < 0.3


def test_more_markers_than_labels_are_refused() -> None:
    names = [f"m{number}" for number in range(256)]
    with pytest.raises(ConfigError, match="at most 255"):
        build_color_table(ColorsFile(markers={}), names)
    assert len(build_color_table(ColorsFile(markers={}), names[:255]).labels) == TABLE_SIZE


def test_a_faint_colour_is_likelier_paint_than_skin_or_background_and_no_longer_typical() -> None:
    def one(rgb: RgbColor) -> GaussianColor:
        return GaussianColor(components=(ColorComponent(rgb=rgb, sigma=(0.07, 0.07, 0.25)),))

    def faint(colors: ColorsFile, rgb: RgbColor) -> int:
        packed = np.asarray(cv2.cvtColor(np.array([[rgb[::-1]]], np.uint8), cv2.COLOR_BGR2BGR565)).view(np.uint16)
        return int(build_color_table(colors, ["ring"]).faint[packed[0, 0, 0]])

    paint, skin = (200, 60, 60), (200, 160, 130)
    mixed = (200, 95, 85)
    alone = ColorsFile(markers={"ring": one(paint)})
    known = alone.model_copy(update={"skin": one(skin), "background": one((30, 30, 30))})
    assert label_of(build_color_table(known, ["ring"]), mixed) == ""
    assert [faint(known, each) for each in (paint, mixed, skin, (30, 30, 30), (60, 200, 60))] == [1, 1, 0, 0, 0]
    assert faint(alone, mixed) == 0, "without skin and background nothing tells what is mixed"
