from __future__ import annotations

import json
from pathlib import Path

import cv2
import numpy as np
import pytest
from marker_scenes import DICTIONARY, SIZE_M, background, depth_camera, draw_marker, tilted, with_noise

from rhot.aruco_dictionary import marker_dictionary
from rhot.geometry.hull import Region
from rhot_feet.marker.detection import MarkerFinder
from rhot_feet.marker.pose import square_corners

CAMERA = depth_camera()
FINDER = MarkerFinder(marker_dictionary(DICTIONARY), [0, 1])


@pytest.mark.parametrize(("z", "tilt_deg"), [(0.7, 10.0), (1.1, 35.0), (1.5, 20.0)])
def test_corners_are_found_to_a_tenth_of_a_pixel(z: float, tilt_deg: float) -> None:
    errors = []
    for seed in range(8):
        rng = np.random.default_rng(seed)
        R = tilted(tilt_deg, rng.uniform(0, 6.28), rng.uniform(-0.4, 0.4))
        t = np.array([rng.uniform(-0.2, 0.2), rng.uniform(-0.15, 0.15), z])
        color = background(CAMERA, seed)
        draw_marker(color, CAMERA, 1, R, t)
        (found,) = FINDER.find(with_noise(color, seed))
        assert found.marker_id == 1
        errors.append(found.corners - CAMERA.project(square_corners(SIZE_M) @ R.T + t))
        assert found.corner_sigma_px < 0.3
    assert float(np.sqrt(np.mean(np.square(errors)))) < 0.1


def test_a_region_gives_the_corners_of_the_whole_picture() -> None:
    color = background(CAMERA)
    draw_marker(color, CAMERA, 0, tilted(15.0, 0.3), np.array([0.1, 0.05, 1.0]))
    color = with_noise(color)
    (whole,) = FINDER.find(color)
    u, v = whole.corners.mean(axis=0).astype(int)
    (part,) = FINDER.find(color, Region(int(u) - 60, int(v) - 50, int(u) + 70, int(v) + 55))
    np.testing.assert_allclose(part.corners, whole.corners, atol=0.05)
    assert FINDER.find(color, Region(0, 0, 100, 100)) == []
    assert FINDER.find(color, Region(5, 5, 9, 9)) == []


def test_markers_that_no_foot_wears_are_not_found() -> None:
    color = background(CAMERA)
    draw_marker(color, CAMERA, 7, tilted(15.0, 0.3), np.array([0.1, 0.05, 1.0]))
    assert FINDER.find(with_noise(color)) == []


def test_a_mirrored_marker_is_not_found() -> None:
    color = background(CAMERA)
    draw_marker(color, CAMERA, 1, tilted(15.0, 0.3), np.array([0.1, 0.05, 1.0]))
    color = with_noise(color)
    assert len(FINDER.find(color)) == 1
    assert FINDER.find(np.ascontiguousarray(color[:, ::-1])) == []


def test_recorded_photographs_match_the_reference(shared_data: Path) -> None:
    folder = shared_data / "aruco" / "images"
    reference = json.loads((folder / "reference_detections.json").read_text())
    finder = MarkerFinder(marker_dictionary("6X6_250"), range(250))
    compared = 0
    for name, expected in reference.items():
        if not (folder / name).exists():
            continue
        color = np.asarray(cv2.imread(str(folder / name)), dtype=np.uint8)
        found = {detection.marker_id: detection for detection in finder.find(color)}
        assert sorted(found) == sorted(expected["ids"])
        for marker_id, detection in found.items():
            # The reference holds whole pixels, found without refinement.
            distance = np.abs(detection.corners - np.array(expected["corners"][str(marker_id)]))
            assert float(distance.max()) < 1.6
            compared += 1
    assert compared >= 40


def test_film_of_feet_without_markers_gives_none(shared_data: Path) -> None:
    film = cv2.VideoCapture(str(shared_data / "realsense" / "foot_motion_rgb_no_markers.mp4"))
    finder = MarkerFinder(marker_dictionary(DICTIONARY), range(32))
    pictures = found = 0
    while True:
        ok, color = film.read()
        if not ok:
            break
        pictures += 1
        found += len(finder.find(np.asarray(color, dtype=np.uint8)))
    assert pictures == 378
    assert found == 0
