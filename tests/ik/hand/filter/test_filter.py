from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from rhot.anatomy.hand import HandModel
from rhot.arrays import FloatArray
from rhot.geometry.rotations import rotation_from_vector, vector_from_rotation
from rhot.messages import Side
from rhot.rig import HandFile
from rhot_ik.hand.closed_form import FingerGeometry
from rhot_ik.hand.contact import GraspContact, Sphere
from rhot_ik.hand.filter.evidence import CornerNoise, Evidence
from rhot_ik.hand.filter.filter import HandFilter
from rhot_ik.hand.filter.kinematics import HandKinematics
from rhot_ik.hand.filter.process import ANGLES, HandState, angle_covariance, closed_angles, hidden_angles, rest_angles

KNOWN = np.zeros(6, dtype=np.bool_)
BASE_OFFSET = np.array([0.0, 0.014, -0.025])
R_TRUE = rotation_from_vector(np.array([0.4, -0.3, 0.2]))
P_TRUE = np.array([0.02, 0.05, 0.8])


def filter_of(side: Side = "right") -> HandFilter:
    return HandFilter(
        FingerGeometry.of(HandModel.from_file(HandFile(), side), {}),
        BASE_OFFSET,
        np.zeros(6, dtype=np.bool_),
    )


def coupled(model: HandModel, mcp_deg: float, pip_deg: float) -> FloatArray:
    angles = np.zeros((5, 4))
    angles[:, 0], angles[:, 2] = np.radians(mcp_deg), np.radians(pip_deg)
    angles[:, 3] = model.coupling * angles[:, 2]
    return model.clamp(angles).reshape(-1)


def evidence_of(hand: HandFilter, angles: FloatArray, *, hidden: tuple[int, ...] = (), turned: bool = True) -> Evidence:
    tips = hand.tips(hand.start(R_TRUE, P_TRUE, angles))
    tips[list(hidden)] = np.nan
    return Evidence(
        base=P_TRUE + R_TRUE @ BASE_OFFSET,
        base_covariance=np.eye(3) * 0.0005**2,
        rotation=R_TRUE if turned else None,
        rotation_covariance=np.eye(3) * np.radians(1.0) ** 2,
        tips=tips,
        tip_covariances=np.tile(np.eye(3) * 0.001**2, (5, 1, 1)),
        corner_noise=CornerNoise(1.0, 1.0),
    )


def degrees_off(state: HandState) -> float:
    return float(np.degrees(np.linalg.norm(vector_from_rotation(state.R.T @ R_TRUE))))


def test_one_sample_of_all_points_gives_pose_and_angles() -> None:
    hand = filter_of()
    model = HandModel.from_file(HandFile(), "right")
    truth = coupled(model, 30.0, 50.0)
    start = hand.start(R_TRUE @ rotation_from_vector(np.array([0.2, 0.1, -0.2])), P_TRUE + 0.01)
    state = hand.update(start, evidence_of(hand, truth), steps=6)
    # Patch and fingers may be others than the model's, which one sample cannot tell from a turned palm.
    assert degrees_off(state) < 1.0
    assert np.linalg.norm(state.p - P_TRUE) < 0.001
    missed = np.linalg.norm(hand.tips(state) - evidence_of(hand, truth).tips, axis=1)
    assert missed.max() < 0.0005
    assert np.degrees(np.abs(state.angles - truth).reshape(5, 4)[1:, 2]).max() < 4.0


def test_a_sample_teaches_a_share_of_the_person_and_moves_all_else_in_full(monkeypatch: pytest.MonkeyPatch) -> None:
    slow = filter_of()
    model = HandModel.from_file(HandFile(), "right")
    before = slow.predict(slow.start(R_TRUE, P_TRUE, coupled(model, 30.0, 50.0)), 1 / 60)
    evidence = evidence_of(slow, coupled(model, 32.0, 52.0))
    evidence = dataclasses.replace(evidence, base=evidence.base + np.array([0.002, 0.0, 0.001]))
    one = slow.update(before, evidence, steps=1)
    monkeypatch.setattr("rhot_ik.hand.filter.filter.ERROR_LASTS_S", 1 / 60)
    all_of_it = slow.update(before, evidence, steps=1)
    assert np.allclose(one.R, all_of_it.R)
    assert np.allclose(one.p, all_of_it.p)
    assert np.allclose(one.angles, all_of_it.angles)
    assert np.abs(all_of_it.person).max() > 1e-4
    share = (1 / 60) / 0.25
    assert np.allclose(one.person, share * all_of_it.person)


def test_angles_never_leave_their_limits_and_the_tips_still_fit() -> None:
    hand = filter_of()
    model = HandModel.from_file(HandFile(), "right")
    flat = model.clamp(np.zeros((5, 4))).reshape(-1)
    state = hand.start(R_TRUE, P_TRUE)
    for _ in range(30):
        state = hand.update(hand.predict(state, 1 / 60), evidence_of(hand, flat))
        angles = state.angles.reshape(5, 4)
        assert (angles >= model.angle_min).all()
        assert (angles <= model.angle_max).all()
    missed = np.linalg.norm(hand.tips(state) - evidence_of(hand, flat).tips, axis=1)
    assert missed[1:].max() < 0.002


def test_a_hidden_finger_goes_with_its_neighbours() -> None:
    hand = filter_of()
    model = HandModel.from_file(HandFile(), "right")
    state = hand.start(R_TRUE, P_TRUE)
    for share in np.linspace(0.0, 1.0, 60):
        angles = coupled(model, 10.0 + 50.0 * share, 10.0 + 70.0 * share)
        hidden = (3,) if share > 0.2 else ()
        state = hand.update(hand.predict(state, 1 / 60), evidence_of(hand, angles, hidden=hidden))
    ring = np.degrees(state.angles.reshape(5, 4)[3])
    assert ring[0] > 35.0
    assert ring[2] > 50.0


def test_left_alone_the_angles_go_back_to_rest_and_doubt_grows_to_what_is_known_beforehand() -> None:
    hand = filter_of()
    model = HandModel.from_file(HandFile(), "right")
    state = hand.update(hand.start(R_TRUE, P_TRUE), evidence_of(hand, coupled(model, 50.0, 80.0)), steps=4)
    before = np.trace(state.P[ANGLES, ANGLES])
    for _ in range(400):
        state = hand.predict(state, 0.1)
    assert np.allclose(state.angles, rest_angles(model), atol=np.radians(0.5))
    assert np.allclose(state.P[ANGLES, ANGLES], angle_covariance(model), rtol=0.02, atol=1e-4)
    assert np.trace(state.P[ANGLES, ANGLES]) > 2.0 * before


@pytest.mark.parametrize("holds", [False, True])
def test_fingers_that_nobody_sees_close(holds: bool) -> None:
    """Until they meet what they close round, or half of the way where nobody knows what that is."""
    hand = filter_of()
    model = HandModel.from_file(HandFile(), "right")
    state = hand.update(hand.start(R_TRUE, P_TRUE), evidence_of(hand, coupled(model, 20.0, 30.0)), steps=4)
    hidden = np.arange(5) == 2
    for _ in range(60):
        state = hand.predict(state, 0.1, hidden, holds)
    bend = np.degrees(state.angles.reshape(5, 4))
    closed = closed_angles(model) if holds else hidden_angles(model)
    assert np.allclose(bend[2], np.degrees(closed.reshape(5, 4)[2]), atol=1.0)
    assert (bend[[1, 3, 4], 0] < 25.0).all()


@pytest.mark.parametrize("holds", [False, True])
def test_where_a_hidden_finger_was_is_forgotten_as_quickly_as_it_leaves(holds: bool) -> None:
    """In 0.6 s, whether the time passes at once or in frames; what is known of a finger goes with its distance."""
    hand = filter_of()
    model = HandModel.from_file(HandFile(), "right")
    hidden = np.arange(5) == 2
    middle = slice(ANGLES.start + 8, ANGLES.start + 12)
    start = hand.start(R_TRUE, P_TRUE, coupled(model, 20.0, 30.0))
    known = start.P.copy()
    known[middle, middle] = 0.0
    start = dataclasses.replace(start, P=known)
    end = (closed_angles(model) if holds else hidden_angles(model))[8:12]
    for steps in (1, 36):
        state = start
        for _ in range(steps):
            state = hand.predict(state, 0.6 / steps, hidden, holds)
        left = (state.angles[8] - end[0]) / (start.angles[8] - end[0])
        spread = state.P[middle, middle].diagonal() / angle_covariance(model)[8:12, 8:12].diagonal()
        assert np.allclose(spread, 1.0 - left**2)
        assert left == pytest.approx(0.472 if holds else 0.741, abs=1e-3)


def test_a_hidden_finger_ends_at_the_thing_that_it_closes_round() -> None:
    hand = filter_of()
    model = HandModel.from_file(HandFile(), "right")
    angles = coupled(model, 25.0, 30.0)
    state = hand.update(hand.start(R_TRUE, P_TRUE), evidence_of(hand, angles), steps=4)
    held = R_TRUE @ np.array([0.0, -0.055, -0.11]) + P_TRUE
    ball = Sphere(held, 0.034)
    hidden = np.array([False, False, True, False, False])
    geometry = FingerGeometry.of(model, {})
    contact = GraspContact(model, hand, HandKinematics(geometry))
    for shapes in ((), (ball,)):
        closing = state
        for _ in range(120):
            expected = hand.predict(closing, 1 / 60, hidden, holds=True)
            seen = hand.update(expected, evidence_of(hand, angles, hidden=(2,)))
            closing = contact.corrected(seen, hidden, shapes, held=False)
        tip = hand.tips(closing)[2]
        depth = ball.radius_m - np.linalg.norm(tip - held)
        assert (depth < 0.001) == bool(shapes)
        assert np.linalg.eigvalsh(closing.P).min() > -1e-12


def test_covariance_stays_symmetric_and_positive() -> None:
    hand = filter_of()
    model = HandModel.from_file(HandFile(), "right")
    state = hand.start(R_TRUE, P_TRUE)
    for k in range(200):
        angles = coupled(model, 20.0 + 20.0 * np.sin(0.1 * k), 30.0 + 30.0 * np.sin(0.13 * k))
        state = hand.update(hand.predict(state, 1 / 120), evidence_of(hand, angles, turned=k % 3 == 0))
    assert np.array_equal(state.P, state.P.T)
    assert np.linalg.eigvalsh(state.P).min() > -1e-12


def test_one_wild_tip_does_not_turn_the_palm() -> None:
    hand = filter_of()
    model = HandModel.from_file(HandFile(), "right")
    angles = coupled(model, 20.0, 30.0)
    state = hand.start(R_TRUE, P_TRUE)
    for _ in range(30):
        state = hand.update(hand.predict(state, 1 / 60), evidence_of(hand, angles))
    wild = evidence_of(hand, angles)
    tips = wild.tips.copy()
    tips[2] += np.array([0.0, 0.0, 0.08])
    for _ in range(5):
        state = hand.update(hand.predict(state, 1 / 60), dataclasses.replace(wild, tips=tips))
    # The patch may be tilted on the palm by 5°, so its corners alone do not hold it.
    assert degrees_off(state) < 5.0


def test_a_patch_that_lies_otherwise_once_hardly_turns_the_palm_and_one_that_goes_on_does() -> None:
    hand = filter_of()
    truth = coupled(HandModel.from_file(HandFile(), "right"), 30.0, 50.0)
    known = evidence_of(hand, truth)
    before = hand.update(hand.start(R_TRUE, P_TRUE, truth), known, steps=6)
    for _ in range(10):
        before = hand.update(hand.predict(before, 1 / 60), known)
    turned = R_TRUE @ rotation_from_vector(np.array([0.0, np.radians(50.0), 0.0]))
    other = dataclasses.replace(evidence_of(hand, truth, hidden=(0, 1, 2, 3, 4)), rotation=turned)
    state = hand.update(hand.predict(before, 1 / 60), other)
    assert degrees_off(state) < 3.0
    samples = 1
    while degrees_off(state) < 40.0:
        state = hand.update(hand.predict(state, 1 / 60), other)
        samples += 1
    assert samples < 30
