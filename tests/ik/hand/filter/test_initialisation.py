from __future__ import annotations

import dataclasses

import numpy as np

from rhot.anatomy.hand import HandModel, patch_outline
from rhot.arrays import FloatArray
from rhot.geometry.rotations import rotation_from_vector, vector_from_rotation
from rhot.rig import HandFile, IkConfig, MarkerConfig
from rhot_ik.hand.closed_form import FingerGeometry
from rhot_ik.hand.filter.evidence import EvidenceModel, HandObservation
from rhot_ik.hand.filter.filter import HandFilter
from rhot_ik.hand.filter.process import closed_angles, rest_angles
from rhot_ik.hand.solver import HandInitialiser, HandSolver

P_TRUE = np.array([0.02, 0.05, 0.8])
BASE_OFFSET = np.array([0.0, 0.014, -0.025])
OUTLINE = patch_outline(MarkerConfig(joint="wrist", kind="patch", size_m=(0.0435, 0.0235)))
BACK_TO_THE_CAMERA = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]])


def test_one_tip_whose_depth_is_not_known_leaves_the_patch_no_quarter_turn_off() -> None:
    model = HandModel.from_file(HandFile(), "right")
    hand = HandFilter(FingerGeometry.of(model, {}), BASE_OFFSET, np.zeros(6, dtype=np.bool_))
    initialiser = HandInitialiser(hand, EvidenceModel(OUTLINE), BASE_OFFSET, np.zeros(3))
    for seed in range(10):
        rng = np.random.default_rng(seed)
        R = BACK_TO_THE_CAMERA @ rotation_from_vector(np.array([0.0, rng.uniform(-3.0, 3.0), 0.0]))
        R = R @ rotation_from_vector(rng.normal(0.0, 0.4, 3))
        posture = rest_angles(model).reshape(5, 4) + rng.normal(0.0, np.radians(15.0), (5, 4))
        found = initialiser.find(seen_of(hand, R, model.clamp(posture).reshape(-1), seed % 5, rng))
        assert found is not None
        assert np.degrees(np.linalg.norm(vector_from_rotation(found[0].R.T @ R))) < 30.0, seed


def test_a_lone_curled_finger_tells_which_way_round_a_square_patch_lies() -> None:
    outline = patch_outline(MarkerConfig(joint="wrist", kind="patch", size_m=(0.031, 0.030)))
    model = HandModel.from_file(HandFile(), "right")
    hand = HandFilter(FingerGeometry.of(model, {}), BASE_OFFSET, np.zeros(6, dtype=np.bool_))
    initialiser = HandInitialiser(hand, EvidenceModel(outline), BASE_OFFSET, np.zeros(3))
    for case in range(12):
        R = BACK_TO_THE_CAMERA @ rotation_from_vector(np.array([0.0, 0.5 * case, 0.0]))
        R = R @ rotation_from_vector(np.array([0.5, 0.0, 0.0]) if case % 2 else np.array([0.0, 0.0, 0.5]))
        seen = seen_of(hand, R, closed_angles(model), 3 + case % 2, np.random.default_rng(case), outline)
        found = initialiser.find(seen)
        assert found is not None
        assert np.degrees(np.linalg.norm(vector_from_rotation(found[0].R.T @ R))) < 30.0, case


def test_a_palm_a_quarter_turn_off_is_turned_by_the_sides_of_its_patch() -> None:
    """Fingers in postures so odd that the first sample is taken for another palm's."""
    markers = {"base": MarkerConfig(joint="wrist", kind="patch", size_m=(0.034, 0.03))}
    model, outline = HandModel.from_file(HandFile(), "right"), patch_outline(markers["base"])
    hand = HandFilter(FingerGeometry.of(model, {}), BASE_OFFSET, np.zeros(6, dtype=np.bool_))
    for seed in (60, 62, 70, 95, 150):
        rng = np.random.default_rng(seed)
        R = BACK_TO_THE_CAMERA @ rotation_from_vector(np.array([0.0, rng.uniform(-3.0, 3.0), 0.0]))
        R = R @ rotation_from_vector(rng.normal(0.0, 0.4, 3))
        posture = model.clamp(rest_angles(model).reshape(5, 4) + rng.normal(0.0, np.radians(60.0), (5, 4))).reshape(-1)
        solver = HandSolver(model, markers, "base", IkConfig())
        off_deg = []
        for k in range(60):
            seen = seen_of(hand, R, posture, seed % 5, rng, outline)
            solver.solve(dataclasses.replace(seen, t_ns=seen.t_ns + k * 16_666_667))
            assert solver.track is not None
            off_deg.append(np.degrees(np.linalg.norm(vector_from_rotation(solver.track.state.R.T @ R))))
        assert off_deg[0] > 60.0, seed
        assert max(off_deg[30:]) < 15.0, seed


def seen_of(
    hand: HandFilter,
    R: FloatArray,
    posture: FloatArray,
    finger: int,
    rng: np.random.Generator,
    outline: FloatArray = OUTLINE,
) -> HandObservation:
    """Return a hand of which two cameras see the patch and one camera a single tip."""
    tips, covariances = np.full((5, 3), np.nan), np.tile(np.eye(3) * 0.001**2, (5, 1, 1))
    tip = hand.tips(hand.start(R, P_TRUE, posture))[finger]
    ray = tip / np.linalg.norm(tip)
    tips[finger] = tip + rng.normal(0.0, 0.03) * ray
    covariances[finger] += 0.03**2 * np.outer(ray, ray)
    base = P_TRUE + R @ BASE_OFFSET
    corners = outline @ R.T + base + rng.normal(0.0, 0.0003, (4, 3))
    seen = np.ones(5, dtype=np.bool_)
    return HandObservation(10**18, base, True, corners, tips, seen, np.eye(3) * 0.0005**2, covariances)
