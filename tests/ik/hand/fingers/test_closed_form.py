from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from rhot.anatomy.hand import HandModel
from rhot.anatomy.skeleton import FINGERS
from rhot.arrays import FloatArray
from rhot.messages import Side
from rhot.rig import HandFile, MarkerConfig
from rhot_ik.hand.closed_form import AnalyticFingers, FingerGeometry


def geometry_of(side: Side, **hand: object) -> FingerGeometry:
    model = HandModel.from_file(HandFile.model_validate(hand), side)
    return FingerGeometry.of(model, {f: MarkerConfig(hand=side, joint=f"{f}_tip") for f in FINGERS})


@pytest.mark.parametrize("side", ["right", "left"])
@pytest.mark.parametrize("offset_m", [None, (0.002, -0.003, 0.004)])
def test_poses_within_limits_come_back_from_their_markers(
    side: Side,
    offset_m: tuple[float, float, float] | None,
    random_angles: Callable[[HandModel, int, int], FloatArray],
) -> None:
    offsets = {} if offset_m is None else dict.fromkeys(FINGERS, offset_m)
    geometry = geometry_of(side, marker_offsets_m=offsets)
    truth = random_angles(geometry.model, 1, 400)
    targets = geometry.marker_points(truth)
    pose = AnalyticFingers(geometry).solve(targets)
    error = np.linalg.norm(geometry.marker_points(pose.angles) - targets, axis=-1)
    assert error.max() < 1e-3
    assert np.allclose(np.linalg.norm(pose.miss, axis=-1), error, atol=1e-12)
    chains = geometry.model.finger_chains
    middle = np.linalg.norm(chains(pose.angles)[0] - chains(truth)[0], axis=-1)[..., 1:3]
    assert np.percentile(middle, 50) < 1e-5
    assert np.percentile(middle, 95) < 1e-3


@settings(deadline=None, max_examples=100)
@given(target=st.tuples(*[st.one_of(st.floats(-0.3, 0.3), st.sampled_from([0.0, 1e3, -1e3, 1e-12]))] * 3))
def test_any_target_gives_finite_angles_within_limits(target: tuple[float, float, float]) -> None:
    geometry = geometry_of("right")
    angles = AnalyticFingers(geometry).solve(np.tile(target, (5, 1))).angles
    assert np.isfinite(angles).all()
    assert np.array_equal(angles, geometry.model.clamp(angles))


def test_no_legal_pose_of_a_fine_grid_is_much_nearer_to_an_illegal_target() -> None:
    geometry = geometry_of("right")
    model = geometry.model
    solver = AnalyticFingers(geometry)
    share = np.stack(np.meshgrid(*[np.linspace(0.0, 1.0, 21)] * 3, indexing="ij"), -1).reshape(-1, 1, 3)
    grid = np.empty((len(share), 5, 4))
    grid[..., :3] = model.angle_min[:, :3] + share * (model.angle_max - model.angle_min)[:, :3]
    grid[..., 3] = np.minimum(grid[..., 2] * model.coupling, model.angle_max[:, 3])
    reachable = geometry.marker_points(grid)
    rng = np.random.default_rng(2)
    for _ in range(25):
        target = model.knuckles + rng.uniform(-0.1, 0.1, (5, 3))
        found = geometry.marker_points(solver.solve(target).angles)
        error = np.linalg.norm(found - target, axis=-1)
        least = np.linalg.norm(reachable - target, axis=-1).min(axis=0)
        assert (error[1:] <= least[1:] + 0.012).all()


def test_batch_equals_one_at_a_time(right_hand: HandModel) -> None:
    geometry = FingerGeometry.of(right_hand, {})
    solver = AnalyticFingers(geometry)
    targets = right_hand.knuckles + np.random.default_rng(4).uniform(-0.09, 0.09, (6, 5, 3))
    together = solver.solve(targets).angles
    assert np.allclose(together, [solver.solve(row).angles for row in targets], atol=1e-12)
