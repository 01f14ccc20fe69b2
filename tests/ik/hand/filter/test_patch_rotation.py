from __future__ import annotations

import numpy as np
import pytest

from rhot.geometry.rotations import rotation_from_vector, vector_from_rotation
from rhot_ik.hand.filter.patch_rotation import PatchRotation

OUTLINE = np.array([[-0.02, 0.0, -0.015], [0.02, 0.0, -0.015], [0.02, 0.0, 0.015], [-0.02, 0.0, 0.015]])
R_TRUE = rotation_from_vector(np.array([1.2, 0.3, -0.2]))
AT = np.array([0.05, -0.02, 0.8])


@pytest.mark.parametrize("first", range(4))
@pytest.mark.parametrize("way", [1, -1])
def test_corners_in_any_order_give_the_rotation(first: int, way: int) -> None:
    corners = (OUTLINE @ R_TRUE.T + AT)[[(first + way * k) % 4 for k in range(4)]]
    expected = R_TRUE @ rotation_from_vector(np.array([0.2, -0.3, 0.2]))
    found = PatchRotation(OUTLINE).fit(corners, expected, np.eye(3) * 1e-6)
    assert found is not None
    assert np.allclose(found.rotation, R_TRUE, atol=1e-9)


def test_the_covariance_says_how_far_the_rotation_scatters() -> None:
    covariance = np.diag([0.0003, 0.0003, 0.002]) ** 2
    rng = np.random.default_rng(2)
    errors = []
    for _ in range(400):
        corners = OUTLINE @ R_TRUE.T + AT + rng.multivariate_normal(np.zeros(3), covariance, 4)
        found = PatchRotation(OUTLINE).fit(corners, R_TRUE, covariance)
        assert found is not None
        errors.append(
            np.linalg.solve(np.linalg.cholesky(found.covariance), vector_from_rotation(R_TRUE.T @ found.rotation))
        )
    assert 0.8 < np.array(errors).std() < 1.25


@pytest.mark.parametrize(("width_m", "ways"), [(0.04, 2), (0.031, 4)])
def test_a_rectangle_lies_two_ways_round_and_nearly_a_square_four(width_m: float, ways: int) -> None:
    outline = OUTLINE * (width_m / 0.04, 1.0, 1.0)
    found = PatchRotation(outline).patch_orientations(outline @ R_TRUE.T + AT)
    facing = [R for R in found if R[:, 1] @ R_TRUE[:, 1] > 0.9]
    assert len(facing) == ways
    assert len(found) == 2 * ways
    assert min(float(np.linalg.norm(vector_from_rotation(R.T @ R_TRUE))) for R in facing) < 1e-6


def test_something_else_than_the_patch_is_refused() -> None:
    assert PatchRotation(OUTLINE).fit(2.0 * OUTLINE + AT, np.eye(3), np.eye(3)) is None
    assert PatchRotation(OUTLINE).fit(np.full((4, 3), np.nan), np.eye(3), np.eye(3)) is None


def test_a_patch_a_quarter_turn_off_fits_worse_by_what_is_stated() -> None:
    outline = OUTLINE * (0.036 / 0.04, 1.0, 1.0)
    corners, covariance = outline @ R_TRUE.T + AT, np.eye(3) * 0.001**2
    right = PatchRotation(outline).fit(corners, R_TRUE, covariance)
    wrong = PatchRotation(outline).fit(corners, R_TRUE @ rotation_from_vector(np.array([0.0, 1.5, 0.0])), covariance)
    assert right is not None
    assert wrong is not None
    assert right.quarter_turn == pytest.approx(-wrong.quarter_turn) == pytest.approx(wrong.misfit - right.misfit)
    assert right.quarter_turn > 50.0


def test_sides_that_a_ruler_confuses_tell_nothing_of_a_quarter_turn() -> None:
    outline = OUTLINE * (0.032 / 0.04, 1.0, 1.0)
    found = PatchRotation(outline).fit(outline @ R_TRUE.T + AT, R_TRUE, np.eye(3) * 0.0001**2)
    assert found is not None
    assert found.quarter_turn == 0.0


def test_a_palm_that_is_taken_for_one_half_a_quarter_turn_off_finds_its_patch() -> None:
    outline = OUTLINE * (0.0435 / 0.04, 1.0, 0.0235 / 0.03)
    for turn_deg in (-60.0, -50.0, 50.0, 60.0):
        expected = R_TRUE @ rotation_from_vector(np.array([0.0, np.radians(turn_deg), 0.0]))
        found = PatchRotation(outline).fit(outline @ R_TRUE.T + AT, expected, np.eye(3) * 1e-6)
        assert found is not None
        assert np.allclose(found.rotation, R_TRUE, atol=1e-6)
