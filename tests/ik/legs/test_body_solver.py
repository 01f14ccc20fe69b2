"""Which way knees point."""

from __future__ import annotations

import numpy as np

from rhot.anatomy.body_proportions import BodyModel
from rhot.geometry.rotations import rigid, rotation_y
from rhot.rig import BodyConfig
from rhot_ik.body_core import solve_body
from rhot_ik.legs.hips import Ankle

BODY = BodyModel.from_config(BodyConfig(height_m=1.75))


def knee_direction_deg(foot_yaw_deg: float, trust: float) -> float:
    """Return how far a bent right knee points to the left, of a foot that is turned to the left."""
    hips = rigid(np.eye(3), np.array([0.0, 0.0, 0.0]))
    ankle = rigid(rotation_y(np.radians(foot_yaw_deg)), np.array([BODY.hip_width_m / 2.0, -0.6, 0.0]))
    leg = solve_body(hips, {"right": Ankle(ankle, trust)}, BODY).legs["right"]
    ahead = leg.knee - leg.hip
    return float(np.degrees(np.arctan2(-ahead[0], -ahead[2])))


def test_a_knee_points_mostly_where_the_toes_do() -> None:
    assert 25.0 < knee_direction_deg(40.0, 1.0) < 35.0


def test_a_knee_does_not_follow_a_foot_that_is_only_guessed() -> None:
    assert abs(knee_direction_deg(60.0, 0.02)) < 3.0


def test_a_foot_turned_backwards_does_not_turn_the_knee() -> None:
    assert abs(knee_direction_deg(175.0, 1.0)) < 1.0
