"""Lengths of a person, learned from standing."""

from __future__ import annotations

import numpy as np
import pytest

from rhot.anatomy.body_proportions import BodyModel
from rhot.geometry.rotations import rigid
from rhot.messages import Side
from rhot.rig import BodyConfig
from rhot_ik.body_core import Stature
from rhot_ik.legs.hips import OUTWARDS, Ankle

BODY = BodyModel.from_config(BodyConfig(height_m=1.75))
SIDES: tuple[Side, Side] = ("left", "right")


def stand(stature: Stature, seconds: float, *, legs_m: float, head_m: float, raised_m: float = 0.0) -> None:
    """Let somebody stand whose leg is `legs_m` long and whose hips hang under a head at `head_m`.

    `raised_m` is how much higher the right marker sits than the configuration says.
    """
    ankle_m = head_m - BODY.neck_height_m - legs_m
    for _ in range(round(seconds * 50.0)):
        hips = rigid(np.eye(3), np.array([0.0, head_m - stature.body.neck_height_m, 0.0]))
        ankles = {}
        for side in SIDES:
            wrong_m = -raised_m if side == "right" else 0.0
            height_m = ankle_m + wrong_m + stature.ankles_m[side]
            position = np.array([OUTWARDS[side] * stature.body.hip_width_m / 2.0, height_m, 0.0])
            ankles[side] = Ankle(rigid(np.eye(3), position))
        stature.update(hips, ankles, 0.02)


@pytest.mark.parametrize("longer_m", [-0.02, 0.02])
def test_three_seconds_of_standing_tell_how_long_a_person_is(longer_m: float) -> None:
    stature = Stature(BODY, legs_known=False)
    stand(stature, 3.0, legs_m=BODY.leg_m + longer_m, head_m=1.5)
    learned_m = stature.body.leg_m + stature.body.neck_height_m - BODY.leg_m - BODY.neck_height_m
    assert learned_m == pytest.approx(longer_m, abs=0.004)
    assert stature.body.leg_m - BODY.leg_m == pytest.approx(learned_m / 2.0, abs=1e-9)


def test_legs_that_were_measured_are_kept() -> None:
    stature = Stature(BODY, legs_known=True)
    stand(stature, 3.0, legs_m=BODY.leg_m + 0.02, head_m=1.5)
    assert stature.body.leg_m == pytest.approx(BODY.leg_m)
    assert stature.body.neck_height_m == pytest.approx(BODY.neck_height_m + 0.02, abs=0.004)


def test_a_marker_that_sits_low_bends_no_knee() -> None:
    stature = Stature(BODY, legs_known=False)
    stand(stature, 3.0, legs_m=BODY.leg_m, head_m=1.5, raised_m=0.012)
    assert stature.ankles_m["right"] - stature.ankles_m["left"] == pytest.approx(0.012, abs=0.002)


def test_who_sits_teaches_nothing() -> None:
    stature = Stature(BODY, legs_known=False)
    stand(stature, 5.0, legs_m=0.7 * BODY.leg_m, head_m=1.2)
    assert stature.body == BODY
    assert stature.ankles_m == {"left": 0.0, "right": 0.0}


def test_who_stands_up_after_slouching_is_long_again_soon() -> None:
    stature = Stature(BODY, legs_known=False)
    stand(stature, 10.0, legs_m=BODY.leg_m - 0.02, head_m=1.5)
    stand(stature, 5.0, legs_m=BODY.leg_m, head_m=1.5)
    assert abs(stature.body.leg_m - BODY.leg_m) < 0.005
