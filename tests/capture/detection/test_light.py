"""The colour of the light is followed by what it does to all paints."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
import pytest

from rhot.arrays import ImageArray
from rhot.rig.colors import RgbColor
from rhot_capture.detection.color_table import ColorTable
from rhot_capture.detection.detector import MarkerDetector
from rhot_capture.detection.light import Light

WARM = 1.4, 0.7
"""Red and blue of an evening, relative to green and to the calibration."""


def in_light(image: ImageArray, red: float, blue: float) -> ImageArray:
    return np.asarray(np.clip(np.rint(image * np.array([blue, 1.0, red])), 0.0, 255.0), dtype=np.uint8)


def looked(light: Light, table: ColorTable, paints: Mapping[str, RgbColor], lights: Mapping[str, Any]) -> bool:
    """Show a light some frames of paints, each in a light of its own; return what it says at last."""
    blobs = []
    for name, (red, blue) in lights.items():
        patch = np.tile(np.array(paints[name][::-1], np.uint8), (9, 9, 1))
        blobs.append((table.names.index(name) + 1, in_light(patch, red, blue), np.full((9, 9), 255, np.uint8)))
    return [light.look(table, blobs, lambda _: ()) for _ in range(4)][-1]


def test_markers_are_found_while_the_evening_comes(markers: Any, table: Any, scene: Any, six_shapes: Any) -> None:
    drawn, detector = scene(six_shapes(3), noise=2.0), MarkerDetector(markers, table, 640, 480)
    assert len(MarkerDetector(markers, table, 640, 480).detect(in_light(drawn.image, *WARM))) < 5
    for frame in range(240):
        share = min(frame / 200.0, 1.0)
        found = detector.detect(in_light(drawn.image, *np.power(WARM, share)))
        assert set(found) == set(drawn.truth), f"at {share:.2f} of the way"
    for name, (u, v, _) in drawn.truth.items():
        assert np.hypot(found[name].u - u, found[name].v - v) < 0.5
    assert detector.light == pytest.approx(WARM, rel=0.15)
    # Who calibrates again does so in the light that is.
    detector.table = table
    assert detector.light == (1.0, 1.0)


def test_light_that_stays_is_left_alone(markers: Any, table: Any, scene: Any, six_shapes: Any) -> None:
    detector = MarkerDetector(markers, table, 640, 480)
    for seed in range(40):
        detector.detect(scene(six_shapes(seed % 5), noise=3.0, seed=seed).image)
    assert detector.table is table


def test_what_a_few_paints_do_is_not_the_light(table: Any, paints: Any) -> None:
    light, plain = Light(), dict.fromkeys(paints, (1.0, 1.0))
    two = list(paints)[:2]
    assert not looked(light, table, paints, plain | dict.fromkeys(two, WARM))
    assert not looked(light, table, paints, dict.fromkeys(two, WARM))
    apart = dict(zip(paints, [(1.0, 1.0), (1.3, 1.0), (1.0, 1.3), (0.7, 1.0), (1.0, 0.7), (1.6, 0.6)], strict=False))
    assert not looked(light, table, paints, apart)
    assert not light.shift.any()
    assert looked(light, table, paints, plain | dict.fromkeys(list(paints)[1:], WARM))
    assert np.exp(light.shift) == pytest.approx(WARM, rel=0.15)


def test_a_lamp_that_is_switched_is_found_by_trying(markers: Any, table: Any, scene: Any, six_shapes: Any) -> None:
    drawn, detector = scene(six_shapes(3), noise=2.0), MarkerDetector(markers, table, 640, 480)
    empty = scene([], noise=2.0).image
    for light in ((1.0, 1.0), WARM, (1.0, 1.0), (0.75, 1.3)):
        found = [set(detector.detect(in_light(drawn.image, *light))) for _ in range(100)]
        # Four looks, each sixth frame of a light that was known, and the search.
        assert found[-1] == set(drawn.truth), light
        assert found.index(set(drawn.truth)) <= 36, f"{light}: 0.6 s at 60 Hz"
        assert detector.light == pytest.approx(light, rel=0.1)
        # Nobody is there for a while.
        for _ in range(100):
            assert detector.detect(in_light(empty, *light)) == {}


def test_one_marker_in_view_is_no_reason_to_doubt(markers: Any, table: Any, scene: Any, six_shapes: Any) -> None:
    drawn, detector = scene(six_shapes(3)[:1], noise=2.0), MarkerDetector(markers, table, 640, 480)
    assert all(detector.detect(drawn.image) for _ in range(100))
    assert detector.table is table


def test_paints_that_are_taken_for_others_are_no_tinted_light(table: Any, paints: Any) -> None:
    light = Light()
    looked(light, table, paints, dict.fromkeys(list(paints)[:3], (1.2, 1.25)))
    assert not light.shift.any()
