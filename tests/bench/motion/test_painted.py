"""Painted caps: what faces the camera, what is hidden, and where the middle of it lies."""

from __future__ import annotations

import numpy as np
import pytest

from rhot_bench.motion.painted import Capsules, cap_surface, patch_surface, seen_samples

EYE = np.array([0.0, 0.0, -0.8])
NOTHING = Capsules(np.empty((1, 0, 3)), np.empty((1, 0, 3)), np.empty(0), np.empty(0))


def capsule(a: list[float], b: list[float], radius: float, finger: int = -1) -> Capsules:
    return Capsules(np.array([[a]]), np.array([[b]]), np.array([radius]), np.array([float(finger)]))


def test_area_of_a_cap_is_that_of_half_ball_and_cylinder() -> None:
    radius, length = 0.007, 0.017
    surface = cap_surface(length, radius, radius)
    assert surface.areas.sum() == pytest.approx(
        2 * np.pi * radius**2 + 2 * np.pi * radius * (length - radius), rel=1e-6
    )
    np.testing.assert_allclose(np.linalg.norm(surface.normals, axis=1), 1.0)


def test_middle_of_a_ball_alone_is_five_eighths_of_the_radius_behind_its_tip() -> None:
    assert cap_surface(0.007, 0.007, 0.007).centre[2] == pytest.approx(0.625 * 0.007)


def test_a_tape_leaves_the_tip_bare_and_has_its_middle_further_back() -> None:
    radius, length, bare = 0.007, 0.017, 0.003
    tape, paint = cap_surface(length, radius, radius, bare), cap_surface(length, radius, radius)
    assert bare < tape.points[:, 2].min() < paint.points[:, 2].max() == tape.points[:, 2].max()
    z = np.linspace(bare, length, 20_001)
    area = radius**2 - np.maximum(radius - z, 0.0) ** 2
    assert tape.centre[2] == pytest.approx(np.average(z, weights=area), rel=1e-4)


def test_seen_middle_lies_towards_the_camera_by_a_few_millimetres() -> None:
    surface = cap_surface(0.017, 0.007, 0.007)
    # The bone lies along x, across the line of sight.
    R = np.column_stack([[0.0, 0.0, 1.0], [0.0, 1.0, 0.0], [-1.0, 0.0, 0.0]])
    points, normals = (surface.points @ R.T)[None], (surface.normals @ R.T)[None]
    facing, shown = seen_samples(points, normals, EYE, NOTHING, 0)
    np.testing.assert_array_equal(facing, shown)
    weights = shown[0] * surface.areas
    middle = weights @ points[0] / weights.sum()
    assert 0.003 < -middle[2] < 0.007


def test_a_finger_in_between_hides_and_one_behind_does_not() -> None:
    patch = patch_surface((0.03, 0.02))
    R = np.column_stack([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]])
    points, normals = (patch.points @ R.T)[None], (patch.normals @ R.T)[None]
    before = capsule([-0.05, 0.0, -0.1], [0.05, 0.0, -0.1], 0.02)
    behind = capsule([-0.05, 0.0, 0.1], [0.05, 0.0, 0.1], 0.02)
    assert seen_samples(points, normals, EYE, before, -1)[1].sum() == 0.0
    assert (seen_samples(points, normals, EYE, behind, -1)[1] > 0.0).all()


def test_the_bone_that_wears_the_paint_does_not_hide_it() -> None:
    surface = cap_surface(0.017, 0.007, 0.007)
    own = capsule([0.0, 0.0, 0.007], [0.0, 0.0, 0.03], 0.007, finger=2)
    facing, shown = seen_samples(surface.points[None], surface.normals[None], EYE, own, 2)
    np.testing.assert_array_equal(facing, shown)
