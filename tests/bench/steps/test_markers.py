from __future__ import annotations

import json
from dataclasses import fields
from pathlib import Path

import cv2
import numpy as np
import pytest
from marker_scenes import tilted

from rhot.aruco_dictionary import marker_dictionary
from rhot.errors import ConfigError
from rhot_bench.steps.markers import (
    CAMERA,
    INSET_PX,
    SIDE_M,
    MarkerTest,
    edge_corners,
    follow_marker,
    marker_figures,
    move_edges,
    read_marker_test,
    tilt_figures,
)
from rhot_feet.marker.detection import MarkerFinder
from rhot_feet.marker.pose import square_corners, view_square


def test_edges_move_outwards_by_what_is_asked() -> None:
    square = np.array([[[10.0, 10.0], [30.0, 10.0], [30.0, 40.0], [10.0, 40.0]]])
    wider = np.array([[[9.5, 9.5], [30.5, 9.5], [30.5, 40.5], [9.5, 40.5]]])
    np.testing.assert_allclose(move_edges(square, 0.5), wider)
    leaning = np.array([[[10.0, 12.0], [33.0, 8.0], [30.0, 40.0], [8.0, 35.0]]])
    for start, end, moved in zip(leaning[0], np.roll(leaning[0], -1, axis=0), move_edges(leaning, 0.5)[0], strict=True):
        along = (end - start) / np.linalg.norm(end - start)
        assert float((moved - start) @ (along[1], -along[0])) == pytest.approx(0.5)


def test_the_detectors_whole_pixels_are_found_again() -> None:
    R, t = tilted(25.0, 0.4), np.array([0.1, -0.05, 1.2])
    corners = np.rint(CAMERA.project(square_corners(SIDE_M) @ R.T + t))
    view = view_square(corners, SIDE_M, CAMERA)
    assert view is not None
    test = MarkerTest(np.zeros(1), view.R[None], view.t[None], np.full((1, 3, 3), np.nan), np.full((1, 3), np.nan))
    np.testing.assert_allclose(edge_corners(test), move_edges(corners[None], INSET_PX))


def test_whole_pixel_corners_of_photographs_lie_inside_their_edges(shared_data: Path) -> None:
    folder = shared_data / "aruco" / "images"
    reference = json.loads((folder / "reference_detections.json").read_text())
    finder, insets = MarkerFinder(marker_dictionary("6X6_250"), range(250)), []
    for name in sorted(name for name in reference if (folder / name).exists()):
        for found in finder.find(np.asarray(cv2.imread(str(folder / name)), dtype=np.uint8)):
            whole = np.array([reference[name]["corners"][str(found.marker_id)]], dtype=np.float64)
            outwards = move_edges(whole, 1.0) - whole
            # Both edges at a corner moved by x take it x times as far as by one pixel.
            insets.append(float(((found.corners - whole) * outwards).sum() / (outwards**2).sum()))
    assert len(insets) >= 40
    assert float(np.mean(insets)) == pytest.approx(INSET_PX, abs=0.06)


@pytest.mark.parametrize(("name", "least_right"), [("test0.csv", 0.97), ("test4.csv", 0.78)])
def test_recorded_detections_against_motion_capture(shared_data: Path, name: str, least_right: float) -> None:
    test = read_marker_test(shared_data / "aruco" / "d435_qualisys" / name).first(500)
    figures = marker_figures(test, follow_marker(test))
    assert figures.right > least_right
    assert figures.first_right < 0.8
    assert figures.mean_m < 0.7 * figures.first_mean_m
    assert figures.rms_m < 0.7 * figures.first_rms_m


@pytest.mark.parametrize(("name", "begin"), [("test0.csv", 3500), ("test4.csv", 0)])
def test_what_is_said_to_be_clear_is_right_at_every_tilt(shared_data: Path, name: str, begin: int) -> None:
    """A square that is seen head-on has two poses that nobody tells apart: it must say so, and only then.

    These 1500 detections of each test show every tilt, and are hard; `rhot evaluate steps` tells of all.
    """
    whole = read_marker_test(shared_data / "aruco" / "d435_qualisys" / name)
    test = MarkerTest(*(getattr(whole, each.name)[begin : begin + 1500] for each in fields(whole)))
    figures = tilt_figures(test, follow_marker(test))
    assert len(figures) >= 5
    assert max(figure.clear_wrong for figure in figures) <= 0.02
    assert max(figure.wrong for figure in figures) > 0.1, "the recording is hard enough to tell"
    assert figures[-1].clear > 0.9


def test_what_is_no_table_of_detections_is_refused(tmp_path: Path) -> None:
    file = tmp_path / "test.csv"
    file.write_text("t,det\n0.0,1\n0.1,1\n")
    with pytest.raises(ConfigError, match=r"test\.csv: not a table of marker detections"):
        read_marker_test(file)
