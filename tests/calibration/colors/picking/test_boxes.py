from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from rhot.errors import CalibrationError
from rhot_calibration.colors.calibration import calibrate
from rhot_calibration.colors.picking.picks import Box
from rhot_calibration.colors.picking.regions import regions
from rhot_capture.detection.color_table import build_color_table
from rhot_capture.detection.detector import MarkerDetector

PHOTOS = (
    "GOPR0442.MP4.Standbild001.jpg",
    "no_occclusion_full.jpg",
    "final_finger_markers.jpg",
    "WP_20180522_08_28_56_Rich.jpg",
)


def around(u: float, v: float, half_width: float, half_height: float) -> Box:
    return Box(round(u - half_width), round(v - half_height), round(2 * half_width), round(2 * half_height))


@pytest.mark.parametrize("room_px", [0.0, 6.0])
def test_only_the_paint_in_a_box_counts(scene: Any, six_shapes: Any, room_px: float) -> None:
    drawn = scene(six_shapes(3), noise=3.0)
    half = {name: np.sqrt(area / np.pi) * 1.2 + room_px for name, (_, _, area) in drawn.truth.items()}
    boxes = {name: around(u, v, half[name], half[name]) for name, (u, v, _) in drawn.truth.items()}
    for name, region in regions(drawn.image, boxes).items():
        u, v, area = drawn.truth[name]
        rows, columns = np.nonzero(region)
        assert np.hypot(columns.mean() - u, rows.mean() - v) < 2.0, name
        assert len(rows) == pytest.approx(area, rel=0.3), name


def test_a_box_inside_its_marker_will_do(scene: Any, shape: Any) -> None:
    drawn = scene([shape("base", 100, 100, radius=20, kind="rectangle")], noise=2.0, size=(250, 200))
    region = regions(drawn.image, {"base": Box(90, 92, 20, 16)})["base"]
    assert np.count_nonzero(region) > 0.9 * 20 * 16


@pytest.mark.parametrize(
    ("box", "words"),
    [
        (Box(300, 20, 30, 30), "box ring = 300,20,30,30 in picture 1: only 0 px"),
        (Box(380, 20, 30, 30), "lies outside picture 1, which is 400x200"),
        (Box(90, 90, 20, 2), "at least 4 px"),
    ],
)
def test_a_box_that_shows_nothing_is_named(scene: Any, shape: Any, markers: Any, box: Box, words: str) -> None:
    image = scene([shape("ring", 100, 100)], noise=1.0, size=(400, 200)).image
    with pytest.raises(CalibrationError, match=words):
        calibrate([image], [{"ring": box}], markers)


@pytest.mark.parametrize("room_px", [0.0, 6.0])
@pytest.mark.parametrize("photo", PHOTOS)
def test_boxes_in_real_photos_find_all_markers(thesis_rig: Path, markers: Any, photo: str, room_px: float) -> None:
    photos = json.loads((thesis_rig / "photos" / "markers.json").read_text())["photos"]
    true = {marker["label"]: marker for marker in next(each for each in photos if each["file"] == photo)["markers"]}
    image = np.asarray(cv2.imread(str(thesis_rig / "photos" / photo)), np.uint8)
    height, width = image.shape[:2]
    boxes = {}
    for name, marker in true.items():
        left, top, wide, high = marker["bbox"]
        u, v = max(left - room_px, 0.0), max(top - room_px, 0.0)
        boxes[name] = Box(
            round(u),
            round(v),
            round(min(left + wide + room_px, width) - u),
            round(min(top + high + room_px, height) - v),
        )
    colors = calibrate([image], [boxes], markers).colors
    found = MarkerDetector(markers, build_color_table(colors, list(markers)), width, height).detect(image)
    assert set(found) == set(true)
    for name, marker in true.items():
        assert np.hypot(found[name].u - marker["cx"], found[name].v - marker["cy"]) < 3.0, name
        assert found[name].area == pytest.approx(marker["area_px"], rel=0.35), name
