from __future__ import annotations

import numpy as np

from rhot.geometry.rotations import rotation_from_vector, shortest_rotation
from rhot_ik.hand.filter.evidence import CornerNoise, EvidenceModel, HandObservation, mean_residual_m, measurement_rows


def test_two_points_of_the_wrist_turn_it_the_shortest_way_and_leave_the_turn_about_their_line() -> None:
    truth = rotation_from_vector(np.array([0.3, -0.2, 0.4]))
    expected = truth @ rotation_from_vector(np.array([0.5, 0.1, -0.15]))
    seen = HandObservation(
        10**18, np.array([0.0, 0.0, 0.8]), True, None, np.full((5, 3), np.nan), np.zeros(5, dtype=np.bool_)
    )
    model = EvidenceModel(None)
    assert model.assess(seen, expected).rotation is None
    across = HandObservation(seen.t_ns, seen.base, True, None, seen.tips, seen.tips_measured, across=truth[:, 0])
    evidence = model.assess(across, expected)
    assert evidence.rotation is not None
    assert np.allclose(evidence.rotation[:, 0], truth[:, 0])
    assert evidence.rotation_covariance[0, 0] > 1e4 * evidence.rotation_covariance[1, 1]
    assert model.assess(across, None).rotation is None


def test_the_turn_between_two_directions_takes_one_to_the_other_however_near() -> None:
    rng = np.random.default_rng(2)
    for size in (1.0, 1e-3, 1e-9, 0.0):
        start = rng.normal(size=3)
        start /= np.linalg.norm(start)
        end = start + size * rng.normal(size=3)
        end /= np.linalg.norm(end)
        R = shortest_rotation(start, end)
        assert np.allclose(R @ start, end, atol=1e-9)
        assert np.allclose(R.T @ R, np.eye(3), atol=1e-9)


def test_the_noise_of_corners_is_learned_from_how_far_they_leave_their_plane() -> None:
    rng = np.random.default_rng(3)
    middle = np.diag([0.0003, 0.0003, 0.002]) ** 2
    flat = np.array([[-0.02, -0.015, 0.0], [0.02, -0.015, 0.0], [0.02, 0.015, 0.0], [-0.02, 0.015, 0.0]])
    for factor in (1.0, 9.0):
        noise = CornerNoise(16.0, 8.0)
        for _ in range(400):
            corners = flat + rng.multivariate_normal(np.zeros(3), factor * middle, 4)
            noise = noise.after(corners, middle, 100.0)
        assert 0.6 * factor < noise.factor < 1.6 * factor


def test_how_far_a_ray_reaches_is_no_residual() -> None:
    ray = np.array([0.6, 0.0, 0.8])
    tips, covariances = np.zeros((5, 3)), np.tile(np.eye(3) * 0.001**2, (5, 1, 1))
    tips[2:] = np.nan
    covariances[0] += 0.05**2 * np.outer(ray, ray)
    seen = HandObservation(
        10**18, np.zeros(3), True, None, tips, np.ones(5, dtype=np.bool_), np.eye(3) * 1e-6, covariances
    )
    rows = measurement_rows(EvidenceModel(None).assess(seen, None))
    assert rows is not None
    missed = np.zeros((5, 3))
    missed[0] = 0.06 * ray
    assert mean_residual_m(rows, missed, 0.012) < 0.01
    missed[1] = 0.06 * ray
    assert 0.03 < mean_residual_m(rows, missed, 0.012) < 0.04
    # What is hidden is not missed, and little is what it is.
    missed = np.full((5, 3), 0.001)
    assert np.isclose(mean_residual_m(rows, missed, 0.012), 0.001 * np.sqrt(3.0))
