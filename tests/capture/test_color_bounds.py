"""Bounds of colours: those of learned colours, and the effect of moving them."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from rhot.errors import ConfigError
from rhot.rig import load_rig, write_json_model
from rhot.rig.colors import HsvRangeColor, load_colors, nominal_colors
from rhot.rig.kept_file import KeptFile
from rhot.service.configuration import changed
from rhot_capture.detection.color_table import build_color_table
from rhot_capture.settings import CameraSettings, LiveColors, bounds_of, with_bounds

PAINTS = {"thumb": (220.0, 30.0, 40.0), "index": (40.0, 180.0, 60.0)}
COLORS = nominal_colors(PAINTS)


def within(hue_deg: float, ends: tuple[float, float]) -> bool:
    return (hue_deg - ends[0]) % 360.0 <= (ends[1] - ends[0]) % 360.0


def test_learned_colours_show_where_they_stand_through_red_too() -> None:
    found = bounds_of(COLORS, build_color_table(COLORS, tuple(PAINTS)))
    # By hand: max − min is red − blue or green, so hue = 60° · (G − B) / (R − G) = −3.2°, and 128.6°.
    assert within(356.8, found["thumb"].hue_deg)
    assert not within(30.0, found["thumb"].hue_deg)
    assert within(128.6, found["index"].hue_deg)
    assert found["thumb"].saturation[0] < 1.0 - 30.0 / 220.0 < found["thumb"].saturation[1]
    assert found["thumb"].value[0] < 220.0 / 255.0 <= found["thumb"].value[1] + 0.01
    assert not any(each.in_force for each in found.values())


def test_bounds_in_force_take_in_what_they_say_and_nothing_else() -> None:
    bounds = bounds_of(COLORS, build_color_table(COLORS, tuple(PAINTS)))
    moved = bounds["index"].model_copy(
        update={"hue_deg": (200.0, 260.0), "saturation": (0.5, 1.0), "value": (0.3, 1.0), "in_force": True}
    )
    table = build_color_table(with_bounds(COLORS, {**bounds, "index": moved}), tuple(PAINTS))
    picture = np.array([[[200, 60, 20], [60, 180, 40], [40, 30, 220]]], np.uint8)
    assert table.classify(picture)[0].tolist() == [[2, 0, 1]]


def live(rig_folder: Path) -> tuple[LiveColors, CameraSettings]:
    rig = load_rig(rig_folder)
    write_json_model(rig.colors_path, COLORS)
    colors = LiveColors(rig, tuple(PAINTS), "left")
    settings = CameraSettings.from_config(rig.config.cameras["left"], colors.file)
    return colors, colors.initial(settings)


def test_a_moved_bound_is_in_force_and_a_released_one_goes_back(rig_folder: Path) -> None:
    colors, settings = live(rig_folder)
    asked = changed(settings, {"bounds": {"index": {"hue_deg": [200, 260]}}})
    moved = colors.with_moved_bounds(asked, settings)
    assert moved.bounds["index"].in_force
    assert moved.bounds["index"].saturation == settings.bounds["index"].saturation
    assert moved.bounds["thumb"] == settings.bounds["thumb"]
    released = changed(moved, {"bounds": {"index": {"in_force": False}}})
    assert colors.with_moved_bounds(released, moved) == settings


def test_bounds_that_contradict_themselves_or_name_nobody_are_refused(rig_folder: Path) -> None:
    _, settings = live(rig_folder)
    with pytest.raises(ConfigError, match="saturation: the lower limit"):
        changed(settings, {"bounds": {"index": {"saturation": [0.9, 0.1]}}})
    with pytest.raises(ConfigError, match=r"bounds\.ring: no such marker; this camera knows thumb, index"):
        settings.changed({"bounds": {"ring": settings.bounds["index"].model_dump()}}, 60.0)


def test_saved_bounds_are_in_the_file_and_can_be_undone(rig_folder: Path) -> None:
    colors, settings = live(rig_folder)
    with pytest.raises(ConfigError, match="nothing to save"):
        colors.save_bounds(settings)
    path = load_rig(rig_folder).colors_path
    moved = colors.with_moved_bounds(changed(settings, {"bounds": {"index": {"value": [0.1, 0.9]}}}), settings)
    colors.save_bounds(moved)
    saved = load_colors(path)
    assert isinstance(saved.markers["index"], HsvRangeColor)
    assert saved.markers["index"].value == (0.1, 0.9)
    assert saved.markers["thumb"] == COLORS.markers["thumb"]
    assert colors.has_changed()
    colors.reload()
    after = colors.initial(moved).bounds["index"]
    assert (after.value, after.in_force) == ((0.1, 0.9), False)
    KeptFile(path, type(saved)).undo()
    assert load_colors(path) == COLORS


def test_bounds_are_not_saved_into_colours_on_trial(rig_folder: Path) -> None:
    colors, settings = live(rig_folder)
    moved = colors.with_moved_bounds(changed(settings, {"bounds": {"index": {"value": [0.1, 0.9]}}}), settings)
    KeptFile(load_rig(rig_folder).colors_path, type(COLORS)).try_out(COLORS)
    with pytest.raises(ConfigError, match="on trial"):
        colors.save_bounds(moved)
