from __future__ import annotations

import numpy as np

from rhot.anatomy.hand import HandModel
from rhot.geometry.rotations import rotation_from_vector, vector_from_rotation
from rhot_ik.hand.transitions import FINGER_M_S, PALM_M_S, FingerStepLimit, FingerTransition, PalmTransition


def test_a_finger_sets_out_from_what_was_shown_and_arrives(right_hand: HandModel) -> None:
    transition = FingerTransition(right_hand)
    shown = np.radians(np.tile([60.0, 0.0, 80.0, 53.0], (5, 1)))
    now = np.radians(np.tile([10.0, 0.0, 10.0, 7.0], (5, 1)))
    only_ring = np.arange(5) == 3
    transition.begin(only_ring, now, shown)
    assert np.allclose(transition.apply(now)[3], shown[3])
    assert np.allclose(transition.apply(now)[[0, 1, 2, 4]], now[[0, 1, 2, 4]])
    previous, steps = transition.apply(now), []
    for _ in range(120):
        transition.advance(1 / 60)
        angles = transition.apply(now)
        ends = [right_hand.finger_chains(values)[0][3] for values in (previous, angles)]
        steps.append(np.linalg.norm(ends[1] - ends[0], axis=-1).max())
        previous = angles
    assert max(steps) <= FINGER_M_S / 60 + 1e-9
    assert np.allclose(previous, now)


def test_bounded_angles_move_no_joint_further_than_told(right_hand: HandModel) -> None:
    transition = FingerTransition(right_hand)
    shown, wanted = np.zeros((5, 4)), np.radians(np.tile([80.0, 10.0, 90.0, 60.0], (5, 1)))
    most_m = np.array([0.0, 0.001, 0.01, 0.05, np.inf])
    angles = transition.limit_step(wanted, shown, most_m)
    moved = np.linalg.norm(right_hand.finger_chains(angles)[0] - right_hand.finger_chains(shown)[0], axis=-1)
    assert (moved.max(axis=1) <= most_m + 1e-12).all()
    assert np.array_equal(angles[4], wanted[4])


def test_a_palm_is_led_from_the_expected_pose() -> None:
    transition = PalmTransition()
    expected = rotation_from_vector(np.array([0.1, 0.0, 0.2])), np.array([0.01, 0.0, 0.8])
    now = np.eye(3), np.array([0.0, 0.02, 0.8])
    transition.begin(expected, now)
    R, p = transition.apply(*now)
    assert np.allclose(R, expected[0])
    assert np.allclose(p, expected[1])
    transition.advance(0.05)
    assert np.linalg.norm(transition.apply(*now)[1] - p) <= PALM_M_S * 0.05 + 1e-12
    for _ in range(60):
        transition.advance(1 / 60)
    R, p = transition.apply(*now)
    assert np.linalg.norm(vector_from_rotation(R)) < 1e-9
    assert np.allclose(p, now[1])


def test_a_marker_that_jumps_is_followed_step_by_step() -> None:
    """At rest, then 30 mm further at once: the finger may not go along in one sample."""
    limit, seen = FingerStepLimit(), np.ones(5, dtype=np.bool_)
    for _ in range(10):
        limit.advance(1 / 120, np.zeros(5), seen)
    assert limit.advance(1 / 120, np.full(5, 0.030), seen).max() < 0.005


def test_a_hand_that_speeds_up_as_hands_do_has_limit() -> None:
    limit, seen = FingerStepLimit(), np.ones(5, dtype=np.bool_)
    for k in range(60):
        speed_m_s = 15.0 * k / 120
        assert limit.advance(1 / 120, np.full(5, speed_m_s / 120), seen).min() >= speed_m_s / 120


def test_a_marker_that_returns_gains_trust_in_as_long_as_it_was_hidden() -> None:
    limit, seen = FingerStepLimit(), np.ones(5, dtype=np.bool_)
    hidden = seen.copy()
    hidden[2] = False
    way = np.full(5, 0.005)
    for _ in range(30):
        limit.advance(1 / 120, way, seen)
    for _ in range(6):
        least = limit.advance(1 / 120, np.where(hidden, way, np.nan), hidden)
    assert least[2] < 0.3 * least[0]
    assert least[2] < (back := limit.advance(1 / 120, way, seen))[2] < 0.8 * back[0]
    for _ in range(6):
        back = limit.advance(1 / 120, way, seen)
    assert back[2] == back[0]
