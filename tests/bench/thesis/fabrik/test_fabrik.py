from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from rhot.anatomy.hand import HandModel
from rhot.arrays import FloatArray
from rhot.geometry.rotations import rotation_x, rotation_z
from rhot.rig import HandFile
from rhot_bench.thesis.fabrik import FLEXION, Chains, FabrikFingers, finger_chains, solve
from rhot_ik.hand.closed_form import FingerGeometry


def leg() -> Chains:
    """Hip ball with some twist, knee hinge that bends the other way, ankle hinge."""
    rest = np.tile(np.eye(3), (1, 3, 1, 1))
    rest[0, 1] = rotation_z(np.pi)
    rest[0, 2] = rotation_x(np.radians(90.0))
    bones = np.array([[[0.0, 0.0, -0.42], [0.0, 0.0, -0.40], [0.0, -0.02, -0.15]]])
    low, high = np.zeros((1, 3, 3)), np.zeros((1, 3, 3))
    low[0, 0], high[0, 0] = np.radians([-20.0, -40.0, -30.0]), np.radians([110.0, 30.0, 30.0])
    high[0, 1, FLEXION] = np.radians(140.0)
    low[0, 2, FLEXION], high[0, 2, FLEXION] = np.radians([-40.0, 20.0])
    return Chains(rest, bones, low, high, np.full((1, 3), np.nan))


def snake() -> Chains:
    """Two chains of eight saddle joints."""
    bones = np.tile([0.0, 0.0, -0.1], (2, 8, 1))
    high = np.tile(np.radians([50.0, 25.0, 0.0]), (2, 8, 1))
    return Chains(np.tile(np.eye(3), (2, 8, 1, 1)), bones, -high, high, np.full((2, 8), np.nan))


def fingers() -> Chains:
    return finger_chains(FingerGeometry.of(HandModel.from_file(HandFile(), "right"), {}))


BUILDS: dict[str, Callable[[], Chains]] = {"leg": leg, "snake": snake, "fingers": fingers}

coordinate = st.one_of(
    st.floats(-0.3, 0.3), st.sampled_from([0.0, 1e-12, -1e-9, 1e300, -1e9, 1.0, np.inf, np.nan]), st.floats(-1e6, 1e6)
)


def assert_legal(chains: Chains, angles: FloatArray, points: FloatArray) -> None:
    assert np.isfinite(angles).all()
    assert np.isfinite(points).all()
    assert (angles >= chains.lowest - 1e-12).all()
    assert (angles <= chains.highest + 1e-12).all()
    lengths = np.linalg.norm(np.diff(points, axis=1), axis=-1)
    assert np.abs(lengths - chains.lengths).max() < 1e-12
    rebuilt, _ = chains.forward(angles)
    assert np.array_equal(rebuilt, points)


@pytest.mark.parametrize("build", BUILDS)
@settings(deadline=None, max_examples=40, suppress_health_check=[HealthCheck.too_slow])
@given(target=st.tuples(coordinate, coordinate, coordinate), seed=st.integers(0, 2**31))
def test_any_target_gives_a_legal_pose_with_exact_bones(
    build: str, target: tuple[float, float, float], seed: int
) -> None:
    chains = BUILDS[build]()
    start = np.random.default_rng(seed).uniform(-4.0, 4.0, chains.lowest.shape)
    pose = solve(chains, np.tile(target, (len(start), 1)), start)
    assert_legal(chains, pose.angles, pose.points)
    assert np.isfinite(pose.error).all()


@pytest.mark.parametrize(("build", "worst_m"), [("leg", 1e-3), ("snake", 1e-3), ("fingers", 1e-3)])
def test_reachable_targets_are_reached(build: str, worst_m: float) -> None:
    chains = BUILDS[build]()
    rng = np.random.default_rng(3)
    for _ in range(40):
        angles = chains.clamp(rng.uniform(chains.lowest, chains.highest))
        if build == "fingers":
            angles[:, 2, FLEXION] = chains.coupling[:, 2] * angles[:, 1, FLEXION]
        points, _ = chains.forward(chains.clamp(angles))
        pose = solve(chains, points[:, -1], np.zeros_like(angles), max_iterations=150)
        assert pose.error.max() < worst_m


def test_out_of_reach_the_finger_stretches_towards_the_target() -> None:
    chains = fingers()
    pose = solve(chains, np.tile([0.0, -0.3, -1.0], (5, 1)), np.full((5, 3, 3), 0.4), max_iterations=200)
    reach = chains.lengths.sum(axis=1)
    straight = np.linalg.norm(pose.points[1:, -1], axis=1)
    assert np.allclose(straight, reach[1:], atol=1e-3)
    direction = pose.points[1:, -1] / straight[:, None]
    assert np.allclose(direction, np.array([0.0, -0.3, -1.0]) / np.sqrt(1.09), atol=0.02)


def test_straight_chain_bends_for_a_target_on_its_own_line() -> None:
    start = np.zeros((5, 3, 3))
    start[:, 0, FLEXION] = np.radians(40.0)
    chains = fingers()
    points, _ = chains.forward(start)
    pose = solve(chains, 0.75 * points[:, -1], start, max_iterations=60)
    assert pose.error.max() < 1e-3
    assert pose.angles[:, 1, FLEXION].min() > 0.3


def test_warm_start_at_the_solution_needs_no_iteration() -> None:
    chains = fingers()
    angles = chains.clamp(np.full((5, 3, 3), 0.4))
    points, _ = chains.forward(angles)
    pose = solve(chains, points[:, -1], angles)
    assert pose.iterations == 0
    assert np.array_equal(pose.angles, angles)


def test_finger_solver_recovers_tip_and_middle_joints(
    right_hand: HandModel, random_angles: Callable[[HandModel, int, int], FloatArray]
) -> None:
    geometry = FingerGeometry.of(right_hand, {})
    solver = FabrikFingers(geometry)
    truth = random_angles(right_hand, 5, 60)
    middle_errors, tip_errors = [], []
    for angles in truth:
        found, _ = solver.solve(geometry.marker_points(angles), np.full((5, 4), 0.3), 1e-4, 60)
        gap = np.linalg.norm(right_hand.finger_chains(found)[0] - right_hand.finger_chains(angles)[0], axis=-1)
        middle_errors.append(gap[:, 1:3])
        tip_errors.append(gap[:, 3])
        assert np.array_equal(found, right_hand.clamp(found))
    assert np.max(tip_errors) < 1e-3
    assert np.percentile(middle_errors, 95) < 1e-3
