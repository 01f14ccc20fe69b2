"""What is published of tracks: a hand is one body in depth."""

from __future__ import annotations

import numpy as np
import pytest
from hands.pinholes import CAMERAS

from rhot.types import Vector3
from rhot_fusion.filter.systematic import Systematic
from rhot_fusion.filter.tracks import BEHIND_M, BEHIND_SIGMA_M, CALIBRATED, outcome_of, within_hand
from rhot_fusion.views.sightings import Upper

LONG: Upper = (1e-6, 0.0, 0.0, 1e-6, 0.0, 0.08**2)
SHARP: Upper = (1e-6, 0.0, 0.0, 1e-6, 0.0, 1e-6)
BOTH, ONE, NONE = [True, True], [True, False], [False, False]


def published(shown: list[list[bool]]) -> tuple[list[Vector3], list[Upper]]:
    """Return two markers 0.8 m away, and a third that is 1 m away for all that its filter knows."""
    places: list[Vector3] = [(0.05, 0.0, 0.79), (-0.05, 0.0, 0.81), (0.0, 0.0, 1.0)]
    covariances = [SHARP, SHARP, LONG]
    within_hand(places, covariances, [0, 1, 2], shown, (0.0, 0.0, 0.0), -1)
    return places, covariances


def test_a_marker_of_one_camera_gets_the_depth_of_its_hand() -> None:
    places, covariances = published([BOTH, BOTH, ONE])
    # The mean of 1.0 with 80 mm, and of 0.8 and what it lies behind, with its spread and the error of a middle of two.
    prior = 1.5 * BEHIND_SIGMA_M**2
    share = LONG[5] / (LONG[5] + prior)
    assert places[2] == pytest.approx((0.0, 0.0, 1.0 - (0.2 - BEHIND_M) * share))
    assert covariances[2][5] == pytest.approx(LONG[5] * prior / (LONG[5] + prior))
    assert covariances[2][:5] == pytest.approx(LONG[:5])
    assert places[:2] == [(0.05, 0.0, 0.79), (-0.05, 0.0, 0.81)]


def test_the_patch_lies_behind_nothing() -> None:
    places: list[Vector3] = [(0.05, 0.0, 0.8), (0.0, 0.0, 0.8)]
    covariances = [SHARP, LONG]
    within_hand(places, covariances, [0, 1], [BOTH, ONE], (0.0, 0.0, 0.0), 1)
    assert places[1][2] == pytest.approx(0.8)
    places[1] = (0.0, 0.0, 0.8)
    within_hand(places, [SHARP, LONG], [0, 1], [BOTH, ONE], (0.0, 0.0, 0.0), -1)
    assert places[1][2] > 0.83


def test_off_the_axis_it_moves_along_its_ray() -> None:
    sight = np.array([0.3, -0.2, 0.9])
    ray = sight / np.linalg.norm(sight)
    P = 0.08**2 * np.outer(ray, ray) + 1e-6 * np.eye(3)
    xx, xy, xz, yy, yz, zz = P[np.triu_indices(3)].tolist()
    places: list[Vector3] = [(0.25, -0.17, 0.75), (0.3, -0.2, 0.9)]
    covariances: list[Upper] = [SHARP, (xx, xy, xz, yy, yz, zz)]
    within_hand(places, covariances, [0, 1], [BOTH, ONE], (0.0, 0.0, 0.0), -1)
    moved = np.array(places[1]) - sight
    assert np.linalg.norm(np.cross(moved, ray)) < 1e-6
    assert moved @ ray < -0.05


@pytest.mark.parametrize("shown", [[BOTH, BOTH, NONE], [ONE, NONE, ONE], [BOTH, BOTH, BOTH]])
def test_else_nothing_changes(shown: list[list[bool]]) -> None:
    places, covariances = published(shown)
    assert places[2] == (0.0, 0.0, 1.0)
    assert covariances[2] == LONG


def test_what_is_known_worse_than_a_finger_is_broad_is_not_measured() -> None:
    """Frames that tell little, or paint that is hidden, leave it uncertain; a calibration is as good as it is."""
    places: list[Vector3] = [(0.05 * k, 0.0, 0.8) for k in range(4)]
    wide: Upper = (1e-6, 0.0, 0.0, 1e-6, 0.0, 0.015**2)
    systematic = Systematic(CAMERAS, {"expected_error_mm": {"80 cm": {"calibration": 20.0}}}, 0.1, np.zeros(4))
    seen = [[True, True, True, True], [True, True, True, False]]
    hidden_m2 = [0.0, 0.0, 0.012**2, 0.0]
    columns = seen, systematic, CALIBRATED
    outcome = outcome_of(0.0, places, [SHARP, wide, SHARP, SHARP], *columns, 0.0, hidden_m2)
    assert outcome.state == ["measured", "predicted", "predicted", "one_view"]
    assert outcome.measured == [True, False, False, False]
    assert outcome.sigma_m[0] > 0.02, "the calibration's error is stated"
    coarse = outcome_of(0.0, places, [SHARP, wide, SHARP, SHARP], *columns, (0.012 / 0.8**2) ** 2, hidden_m2)
    assert coarse.state == ["measured", "measured", "predicted", "one_view"], "coarse pixels tell no more of any frame"
