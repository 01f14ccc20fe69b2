from __future__ import annotations

import cv2
import numpy as np
import pytest

from rhot.aruco_dictionary import R_FOOT_MARKER, marker_cells, marker_corners_m, marker_dictionary
from rhot.errors import ConfigError


def distances(name: str, count: int) -> np.ndarray:
    """Bits between two of the first markers at their most alike turns."""
    dictionary = marker_dictionary(name)
    table = np.zeros((count, count), dtype=int)
    for a in range(count):
        bits = cv2.aruco.Dictionary.getBitsFromByteList(dictionary.bytesList[a : a + 1], dictionary.markerSize)
        table[a] = [dictionary.getDistanceToId(bits, b) for b in range(count)]
    return table


def test_markers_with_low_numbers_are_far_from_one_another() -> None:
    off_diagonal = ~np.eye(4, dtype=bool)
    assert distances("3X3_32", 4)[off_diagonal].min() >= 4
    everything = distances("3X3_32", 32)
    assert everything[~np.eye(32, dtype=bool)].min() >= 1


def test_printed_markers_stay_valid() -> None:
    assert marker_cells("3X3_32", 0)[1:-1, 1:-1].tolist() == [[1, 1, 1], [0, 0, 0], [0, 0, 0]]
    assert marker_cells("3X3_32", 1)[1:-1, 1:-1].tolist() == [[0, 0, 1], [1, 1, 0], [0, 0, 0]]


@pytest.mark.parametrize("name", ["3X3_32", "4X4_50"])
def test_opencv_finds_every_marker_as_itself(name: str) -> None:
    dictionary = marker_dictionary(name)
    detector = cv2.aruco.ArucoDetector(dictionary, cv2.aruco.DetectorParameters())
    for marker_id in range(8):
        cells = marker_cells(name, marker_id)
        side = 20 * len(cells)
        picture = np.full((side + 80, side + 80), 255, dtype=np.uint8)
        picture[40 : 40 + side, 40 : 40 + side] = np.kron(255 * cells, np.ones((20, 20), dtype=np.uint8))
        corners, ids, _ = detector.detectMarkers(picture)
        assert ids.ravel().tolist() == [marker_id]
        # The first corner is the upper left one as printed.
        assert corners[0][0][0] == pytest.approx([40.0, 40.0], abs=1.0)


def test_corners_lie_on_the_foot_in_the_detectors_order() -> None:
    corners = marker_corners_m(0.06)
    # Upper left as printed: left, and towards the toes (-z).
    assert corners[0] == pytest.approx([-0.03, 0.0, -0.03])
    assert corners[2] == pytest.approx([0.03, 0.0, 0.03])
    assert np.linalg.det(R_FOOT_MARKER) == pytest.approx(1.0)


@pytest.mark.parametrize(("name", "marker_id"), [("3X4_9", 0), ("3X3_32", 32), ("3X3_32", -1), ("ARUCO_ORIGINAL_", 0)])
def test_what_is_not_there_is_named(name: str, marker_id: int) -> None:
    with pytest.raises(ConfigError, match=name if marker_id == 0 else str(marker_id)):
        marker_cells(name, marker_id)
