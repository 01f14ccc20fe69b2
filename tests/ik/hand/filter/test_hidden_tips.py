from __future__ import annotations

import numpy as np

from rhot_ik.hand.filter.hidden_tips import Occlusion, OcclusionSettings

STARTS = np.zeros((15, 3))
ENDS = np.tile([0.0, -0.1, 0.0], (15, 1))
CAMERA = np.array([0.0, 0.0, -0.8])
SETTINGS = OcclusionSettings()


def test_a_hidden_tip_beside_the_only_bone_is_expected_behind_it() -> None:
    """A bone along y; the camera looks along z."""
    occlusion = Occlusion(np.full(15, 0.009), SETTINGS)
    behind, beside = np.array([0.001, -0.05, 0.03]), np.array([0.03, -0.05, 0.03])
    tips = np.array([behind, beside, beside, behind, behind])
    would, points, covariances = occlusion.expected(tips, STARTS, ENDS, CAMERA)
    assert would.tolist() == [False, True, True, False, False]
    assert abs(points[1, 0]) < 0.009 - 0.5 * SETTINGS.inside_m
    assert np.allclose(points[1, 1:], beside[1:], atol=0.004)
    assert np.sqrt(covariances[1, 0, 0]) < 0.02
    assert np.sqrt(covariances[1, 2, 2]) > 0.4


def test_a_tip_before_the_bone_is_not_hidden_by_it() -> None:
    occlusion = Occlusion(np.full(15, 0.009), SETTINGS)
    would, _, _ = occlusion.expected(np.tile([0.0, -0.05, -0.03], (5, 1)), STARTS, ENDS, CAMERA)
    assert would.all()
