"""Hips from head and feet: where people's are, and within reach of both legs."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from rhot.anatomy.body_proportions import BodyModel
from rhot.geometry.rotations import rigid, rotation_x, rotation_y
from rhot.messages import Side
from rhot.rig import BodyConfig
from rhot_ik.legs.hips import Ankle, estimate_hips, hip_joint

BODY = BodyModel.from_config(BodyConfig(height_m=1.75))
UP = np.array([0.0, 1.0, 0.0])
ANKLE_Y = 0.09


def standing_head(yaw_rad: float = 0.0, pitch_rad: float = 0.0) -> NDArray[np.float64]:
    """The headset of somebody who stands over the origin, the head's pivot over the ankles."""
    pivot = np.array([0.0, ANKLE_Y + BODY.leg_m + BODY.neck_height_m, 0.0])
    R = rotation_y(yaw_rad) @ rotation_x(-pitch_rad)
    return rigid(R, pivot - R @ np.array(BODY.neck_m))


def feet(yaw_rad: float = 0.0, apart_m: float = 0.2) -> dict[Side, Ankle]:
    R = rotation_y(yaw_rad)
    sides: tuple[tuple[Side, float], ...] = (("left", -1.0), ("right", 1.0))
    return {
        side: Ankle(rigid(R, R @ np.array([sign * apart_m / 2.0, 0.0, 0.0]) + [0.0, ANKLE_Y, 0.0]))
        for side, sign in sides
    }


@pytest.mark.parametrize("yaw_deg", [0.0, 70.0, -160.0])
def test_standing_hips_are_under_the_head_and_turned_as_the_feet(yaw_deg: float) -> None:
    yaw = np.radians(yaw_deg)
    T = estimate_hips(standing_head(yaw), feet(yaw), UP, BODY)
    assert np.linalg.norm(T[[0, 2], 3]) < 0.06
    assert T[1, 3] == pytest.approx(ANKLE_Y + BODY.leg_m, abs=0.02)
    np.testing.assert_allclose(T[:3, :3], rotation_y(yaw), atol=1e-9)


def test_a_head_that_looks_aside_turns_the_hips_little() -> None:
    T = estimate_hips(standing_head(np.radians(60.0)), feet(), UP, BODY)
    turned = np.degrees(np.arctan2(-T[2, 0], T[0, 0]))
    assert 0.0 < turned < 20.0


def test_bowing_over_the_toes_sends_the_hips_backwards() -> None:
    head = standing_head()
    head[:3, 3] += [0.0, -0.15, -0.4]
    T = estimate_hips(head, feet(), UP, BODY)
    assert T[2, 3] > head[2, 3] + 0.25


@given(
    st.floats(-0.6, 0.6),
    st.floats(-0.6, 0.6),
    st.floats(-3.0, 3.0),
    st.floats(-0.5, 1.5),
    st.floats(0.05, 1.0),
    st.sampled_from([("left",), ("right",), ("left", "right")]),
)
def test_every_leg_that_can_reach_does(
    x: float, z: float, yaw: float, pitch: float, lift: float, sides: tuple[Side, ...]
) -> None:
    ankles = {side: ankle for side, ankle in feet(yaw).items() if side in sides}
    ankles[sides[0]].T_rig_ankle[:3, 3] += [x, lift, z]
    T = estimate_hips(standing_head(yaw, pitch), ankles, UP, BODY)
    assert np.isfinite(T).all()
    for side, ankle in ankles.items():
        joint = T[:3, :3] @ hip_joint(side, BODY) + T[:3, 3]
        assert np.linalg.norm(joint - ankle.position) <= BODY.leg_m * 1.001


def test_another_up_is_only_another_frame() -> None:
    turn = rotation_x(np.radians(-90.0))
    head, ankles = standing_head(0.3, 0.4), feet(0.2)
    expected = estimate_hips(head, ankles, UP, BODY)
    T_turn = rigid(turn, np.zeros(3))
    T = estimate_hips(
        T_turn @ head, {side: Ankle(T_turn @ ankle.T_rig_ankle) for side, ankle in ankles.items()}, turn @ UP, BODY
    )
    np.testing.assert_allclose(T, T_turn @ expected, atol=1e-9)


def test_a_foot_that_is_only_guessed_does_not_move_the_hips() -> None:
    ankles = feet()
    expected = estimate_hips(standing_head(), ankles, UP, BODY)
    stray = ankles["left"].T_rig_ankle.copy()
    stray[:3, 3] += [-0.2, 0.1, 0.7]
    moved = {}
    for trust in (1.0, 0.02):
        guessed = {**ankles, "left": Ankle(stray, trust)}
        T = estimate_hips(standing_head(), guessed, UP, BODY)
        moved[trust] = float(np.linalg.norm(T[:3, 3] - expected[:3, 3]))
    assert moved[1.0] > 0.08, "a foot that is really there does"
    assert moved[0.02] < 0.02


def test_a_foot_that_is_only_guessed_does_not_turn_the_hips() -> None:
    ankles = feet()
    turned = Ankle(ankles["left"].T_rig_ankle @ rigid(rotation_y(1.0), np.zeros(3)), 0.02)
    T = estimate_hips(standing_head(), {**ankles, "left": turned}, UP, BODY)
    assert abs(np.degrees(np.arctan2(-T[2, 0], T[0, 0]))) < 2.0


def test_nobody_is_balanced_over_one_foot_whose_other_is_only_guessed() -> None:
    """The left foot is a long step in front, and is taken to be beside the right one behind."""
    ankles = feet()
    ankles["left"].T_rig_ankle[2, 3] -= 0.3
    ankles["right"].T_rig_ankle[2, 3] += 0.3
    head = standing_head()
    head[1, 3] -= 0.05
    expected = estimate_hips(head, ankles, UP, BODY)
    behind = ankles["left"].T_rig_ankle.copy()
    behind[2, 3] += 0.6
    T = estimate_hips(head, {**ankles, "left": Ankle(behind, 0.02)}, UP, BODY)
    assert np.linalg.norm(T[:3, 3] - expected[:3, 3]) < 0.04
    both = estimate_hips(head, {**ankles, "left": Ankle(behind)}, UP, BODY)
    assert np.linalg.norm(both[:3, 3] - expected[:3, 3]) > 0.06, "were it really there it would matter"
