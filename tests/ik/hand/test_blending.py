from __future__ import annotations

import numpy as np
import pytest

from rhot.anatomy.hand import HandModel
from rhot_ik.hand.blending import blended, with_own_motion
from rhot_ik.hand.closed_form import FingerGeometry
from rhot_ik.hand.filter.kinematics import HandKinematics


def test_a_finger_that_is_led_in_arrives_by_bounded_steps(right_hand: HandModel) -> None:
    geometry = FingerGeometry.of(right_hand, {})
    shown = np.radians(np.tile([60.0, 0.0, 80.0, 53.0], (5, 1)))
    known = np.radians(np.tile([58.0, 0.0, 78.0, 52.0], (5, 1)))
    known[3] = np.radians([10.0, 0.0, 10.0, 7.0])
    left_s = np.where(np.arange(5) == 3, 0.1, 0.0)
    steps = []
    for _ in range(40):
        before = geometry.marker_points(shown)[3]
        shown, left_s = blended(HandKinematics(geometry), known, shown, left_s, 1 / 60)
        steps.append(np.linalg.norm(geometry.marker_points(shown)[3] - before))
        assert np.array_equal(shown[[0, 1, 2, 4]], known[[0, 1, 2, 4]])
    assert max(steps) < 1.1 * (0.0058 + 0.05 / 60)
    assert np.allclose(shown, known)
    assert not left_s.any()


def test_a_finger_is_led_in_for_as_long_at_fewer_samples_a_second(right_hand: HandModel) -> None:
    kinematics = HandKinematics(FingerGeometry.of(right_hand, {}))
    took_s = []
    for rate_hz in (60, 15):
        shown, left_s = np.zeros((5, 4)), np.full(5, 0.1)
        known = np.radians(np.tile([50.0, 0.0, 50.0, 33.0], (5, 1)))
        samples = 0
        while left_s.any():
            shown, left_s = blended(kinematics, known, shown, left_s, 1 / rate_hz)
            samples += 1
        took_s.append(samples / rate_hz)
    assert took_s[1] < took_s[0] + 2 / 15


def test_a_finger_that_goes_as_fast_as_hands_do_is_not_held_back(right_hand: HandModel) -> None:
    """Led in, at 0.2 m/s of its tip and 60 samples a second."""
    geometry = FingerGeometry.of(right_hand, {})
    shown, left_s = np.zeros((5, 4)), np.full(5, 0.1)
    for k in range(30):
        known = np.zeros((5, 4))
        known[:, 0] = 0.2 / 0.09 * k / 60
        shown, left_s = blended(HandKinematics(geometry), known, shown, left_s, 1 / 60)
        assert np.allclose(shown, known)


def test_a_tip_that_goes_faster_than_fingers_do_is_led_in_as_if_it_came_back(right_hand: HandModel) -> None:
    """It was seen all along, as what turned out to be something else."""
    geometry = FingerGeometry.of(right_hand, {})
    shown, known = np.zeros((5, 4)), np.zeros((5, 4))
    known[2, 0] = np.radians(60.0)
    angles, _ = blended(HandKinematics(geometry), known, shown, np.zeros(5), 1 / 60)
    step = np.linalg.norm(geometry.marker_points(angles)[2] - geometry.marker_points(shown)[2])
    assert 0.001 < step < 1.1 * (0.0058 + 0.05 / 60)


def test_a_finger_that_is_led_in_goes_its_own_way_as_well_unless_it_jumps(right_hand: HandModel) -> None:
    kinematics = HandKinematics(FingerGeometry.of(right_hand, {}))
    moved = np.zeros((5, 4))
    moved[:, 0] = np.radians([3.0, 3.0, 3.0, 3.0, 60.0])
    led = np.array([True, False, True, False, True])
    moved_on = with_own_motion(kinematics, np.zeros((5, 4)), moved, led, 1 / 60)
    assert np.degrees(moved_on[:, 0]).tolist() == pytest.approx([3.0, 0.0, 3.0, 0.0, 0.0])
