from __future__ import annotations

import math
from itertools import pairwise

import numpy as np
import pytest

from rhot.anatomy.hand import HandModel
from rhot.rig import HandFile
from rhot.types import Vector3
from rhot_bench.speed.cores import thesis_fingers
from rhot_bench.thesis.hand import ROTOR_DEG, TOLERANCE_M, ThesisFinger, ThesisHand, solve_finger

MODEL = HandModel.from_file(HandFile(), "right")
INDEX = thesis_fingers(MODEL)[1]


def target_of(degrees: tuple[float, float, float, float]) -> Vector3:
    angles = np.zeros((5, 4))
    angles[1] = np.radians(degrees)
    x, y, z = MODEL.finger_chains(angles)[0][1, 3].tolist()
    return (x, y, z)


def turns_deg(finger: ThesisFinger, points: list[Vector3]) -> list[float]:
    bones = np.diff(np.array(points), axis=0)
    bones /= np.linalg.norm(bones, axis=1, keepdims=True)
    axis = np.array(finger.axis)
    return [math.degrees(math.atan2(float(np.cross(a, b) @ axis), float(a @ b))) for a, b in pairwise(bones)]


def test_a_curled_finger_is_reached_within_the_tolerance() -> None:
    target = target_of((10.0, 0.0, 50.0, 35.0))
    points = solve_finger(INDEX, target, INDEX.straight())
    assert math.dist(points[3], target) < TOLERANCE_M
    lengths = np.linalg.norm(np.diff(np.array(points), axis=0), axis=1)
    np.testing.assert_allclose(lengths, INDEX.lengths, atol=1e-9)
    assert points[0] == INDEX.base


@pytest.mark.parametrize("degrees", [(0, 0, 100, 80), (70, 0, 10, 5), (-20, 15, 0, 0), (30, -10, 90, 60)])
def test_limits_hold_for_any_target(degrees: tuple[float, float, float, float]) -> None:
    points = solve_finger(INDEX, target_of(degrees), INDEX.straight())
    for turn, limit in zip(turns_deg(INDEX, points), (110.0, 90.0), strict=True):
        assert -0.5 < turn < limit + 0.5
    first = np.subtract(points[1], points[0]) / INDEX.lengths[0]
    assert math.degrees(math.acos(min(1.0, float(first @ INDEX.forward)))) < ROTOR_DEG[1] + 0.1


def test_the_cone_forbids_real_knuckle_flexion() -> None:
    target = target_of((70.0, 0.0, 5.0, 3.0))
    assert math.dist(solve_finger(INDEX, target, INDEX.straight())[3], target) > TOLERANCE_M


def test_reaching_the_tip_leaves_the_middle_joints_wrong() -> None:
    angles = np.radians(np.tile([45.0, 0.0, 25.0, 17.0], (5, 1)))
    true = MODEL.finger_chains(angles)[0]
    targets = [tuple(tip) for tip in true[:, 3].tolist()]
    hand = ThesisHand(thesis_fingers(MODEL))
    found = np.array(hand.solve(targets))
    middle_mm = np.linalg.norm(found - true, axis=2)[1:, 1:3].mean() * 1e3
    assert 2.0 < middle_mm < 30.0
    again = np.array(hand.solve(targets))
    assert np.linalg.norm(again[:, 3] - true[:, 3], axis=1).max() < 0.03
