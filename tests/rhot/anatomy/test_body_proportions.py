from __future__ import annotations

import pytest

from rhot.anatomy.body_proportions import BodyModel
from rhot.rig import BodyConfig


@pytest.mark.parametrize("height_m", [1.5, 1.75, 2.0])
def test_lengths_follow_from_the_height_as_published(height_m: float) -> None:
    body = BodyModel.from_config(BodyConfig(height_m=height_m))
    # Hips at 0.530 and eyes at 0.936 of the height.
    assert body.leg_m + body.ankle_height_m == pytest.approx(0.530 * height_m)
    eyes = body.leg_m + body.ankle_height_m - (body.neck_m[1] - body.neck_height_m)
    assert eyes == pytest.approx(0.936 * height_m)
    assert body.heel_m - body.ball_m[2] < body.foot_length_m


def test_measured_lengths_are_kept() -> None:
    body = BodyModel.from_config(BodyConfig(height_m=1.8, thigh_m=0.5, shank_m=0.4, hip_width_m=0.2))
    assert (body.thigh_m, body.shank_m, body.hip_width_m) == (0.5, 0.4, 0.2)
    # The trunk stays that of the height.
    assert body.neck_height_m == BodyModel.from_config(BodyConfig(height_m=1.8)).neck_height_m


def test_a_person_who_is_longer_keeps_thigh_to_shank() -> None:
    body = BodyModel.from_config(BodyConfig(height_m=1.8))
    longer = body.lengthened(0.02, -0.01)
    assert longer.leg_m == pytest.approx(body.leg_m + 0.02)
    assert longer.thigh_m / longer.shank_m == pytest.approx(body.thigh_m / body.shank_m)
    assert longer.neck_height_m == pytest.approx(body.neck_height_m - 0.01)
    assert longer.height_m == body.height_m
