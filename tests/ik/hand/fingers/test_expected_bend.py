from __future__ import annotations

import numpy as np
import pytest

from rhot.anatomy.hand import HandModel
from rhot.rig import HandFile
from rhot_ik.hand.fingers.closed_form import AnalyticFingers
from rhot_ik.hand.fingers.expected_bend import REACH_SIGMA_M, ExpectedBend
from rhot_ik.hand.fingers.geometry import FingerGeometry

GEOMETRY = FingerGeometry.of(HandModel.from_file(HandFile(), "right"), {})
BEND = ExpectedBend(AnalyticFingers(GEOMETRY))


def bent(mcp_deg: float, pip_deg: float) -> np.ndarray:
    angles = np.zeros((5, 4))
    angles[:, 0], angles[:, 2] = np.radians(mcp_deg), np.radians(pip_deg)
    angles[:, 3] = GEOMETRY.model.coupling * angles[:, 2]
    return angles


def test_a_straight_finger_is_shown_a_little_bent_and_a_bent_one_as_it_is() -> None:
    straight, curled = BEND.expected(bent(20.0, 0.0)), BEND.expected(bent(20.0, 55.0))
    assert (np.degrees(straight[1:, 2]) > 5.0).all()
    assert (np.degrees(straight[1:, 2]) < 18.0).all()
    assert np.degrees(np.abs(curled - bent(20.0, 55.0))[1:]).max() < 3.0


@pytest.mark.parametrize("pip_deg", [0.0, 5.0, 12.0, 25.0, 60.0])
def test_the_marker_stays_where_it_is_but_for_the_error_of_reach(pip_deg: float) -> None:
    likely = bent(25.0, pip_deg)
    moved = GEOMETRY.marker_points(BEND.expected(likely)) - GEOMETRY.marker_points(likely)
    assert np.linalg.norm(moved, axis=1).max() < REACH_SIGMA_M


def test_over_errors_of_reach_the_mean_errs_less_than_the_likeliest() -> None:
    """Fingers bent by up to 40°, tips wrong along the finger by 2 mm."""
    rng = np.random.default_rng(4)
    fingers = AnalyticFingers(GEOMETRY)
    likeliest, mean = [], []
    for pip_deg in rng.uniform(0.0, 40.0, 300):
        truth = bent(30.0, pip_deg)
        tips = GEOMETRY.marker_points(truth)
        ray = tips - GEOMETRY.model.knuckles
        ray *= 1.0 + rng.normal(0.0, REACH_SIGMA_M, (5, 1)) / np.linalg.norm(ray, axis=1, keepdims=True)
        found = fingers.solve(GEOMETRY.model.knuckles + ray).angles
        likeliest.append((found - truth)[1:, 2])
        mean.append((BEND.expected(found) - truth)[1:, 2])
    assert np.degrees(np.sqrt(np.mean(np.square(mean)))) < 0.9 * np.degrees(np.sqrt(np.mean(np.square(likeliest))))


def test_limits_hold_for_all_legal_angles() -> None:
    rng = np.random.default_rng(5)
    model = GEOMETRY.model
    for angles in (model.angle_min, model.angle_max, *rng.uniform(model.angle_min, model.angle_max, (200, 5, 4))):
        shown = BEND.expected(angles)
        assert np.isfinite(shown).all()
        assert (shown >= model.angle_min).all()
        assert (shown <= model.angle_max).all()
