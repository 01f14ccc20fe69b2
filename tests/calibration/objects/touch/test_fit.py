from __future__ import annotations

import numpy as np
import pytest
from touched.toucher import BOX, CYLINDER, P_DEVICE_OBJECT, R_DEVICE_OBJECT, SPHERE, Toucher

from rhot.arrays import FloatArray
from rhot.geometry.rotations import rotation_between, rotation_from_vector
from rhot.messages import FacedShape
from rhot_calibration.objects.touch.faces import faces_of, gaps, usual_faces
from rhot_calibration.objects.touch.fit import OffsetFit, fit_offset


def off(fit: OffsetFit, axis_alone: bool = False) -> tuple[float, float]:
    """Return the errors of position, mm, and rotation (of the z axis alone), degrees."""
    R = fit.R_device_object
    turned = float(np.linalg.norm(rotation_between(R_DEVICE_OBJECT, R)))
    if axis_alone:
        turned = float(np.arccos(np.clip(R_DEVICE_OBJECT[:, 2] @ R[:, 2], -1.0, 1.0)))
    return 1e3 * float(np.linalg.norm(fit.p_device_object - P_DEVICE_OBJECT)), float(np.degrees(turned))


@pytest.mark.parametrize("shape", [BOX, CYLINDER, SPHERE])
def test_exact_touches_give_the_exact_offset(shape: FacedShape) -> None:
    touches = Toucher(shape, noise_m=0.0, flesh_m=0.0).touches(usual_faces(shape), 4)
    fit = fit_offset(shape, touches, R_DEVICE_OBJECT)[0]
    off_mm, off_deg = off(fit)
    assert off_mm < 1e-3
    assert off_deg < 1e-3
    assert fit.rms_m < 1e-6


@pytest.mark.parametrize("shape", [BOX, CYLINDER, SPHERE])
@pytest.mark.parametrize("seed", range(6))
def test_with_the_noise_of_a_fingertip_the_offset_is_within_2_mm_and_1_degree(shape: FacedShape, seed: int) -> None:
    toucher = Toucher(shape, seed)
    fit = fit_offset(shape, toucher.touches(faces_of(shape), 8), R_DEVICE_OBJECT)[0]
    off_mm, off_deg = off(fit, axis_alone=shape is CYLINDER)
    assert off_mm < 2.0
    assert off_deg < 1.0
    assert 0.2 < 1e3 * fit.rms_m < 1.2
    # Honest: within 3.5 of its own standard deviations.
    assert off_mm < 3.5e3 * np.sqrt(3) * fit.position_sd_m
    assert off_deg < 3.5 * np.sqrt(3) * np.degrees(fit.rotation_sd_rad) + 1e-6


def test_what_symmetry_leaves_free_stays_as_it_was() -> None:
    before = R_DEVICE_OBJECT @ rotation_from_vector(np.array([0.1, -0.1, 0.9]))
    touches = Toucher(CYLINDER, noise_m=0.0).touches(usual_faces(CYLINDER), 4)
    found = fit_offset(CYLINDER, touches, before)[0].R_device_object
    # Of all rotations about the found axis, this one is the nearest to the earlier.
    near = float(np.trace(before.T @ found))
    for angle in np.radians([-20.0, -1.0, 1.0, 20.0, 180.0]):
        assert np.trace(before.T @ found @ rotation_from_vector(np.array([0.0, 0.0, angle]))) < near
    touches = Toucher(SPHERE, noise_m=0.0).touches(usual_faces(SPHERE), 4)
    np.testing.assert_allclose(fit_offset(SPHERE, touches, before)[0].R_device_object, before, atol=1e-9)


@pytest.mark.parametrize("shape", [BOX, CYLINDER, SPHERE])
def test_slopes_are_the_derivatives_of_distances(shape: FacedShape) -> None:
    rng = np.random.default_rng(2)
    step = 1e-7
    for face in faces_of(shape):
        q = rng.uniform(-0.09, 0.09, (20, 3))
        found = gaps(shape, face, q)

        def moved(shift: FloatArray, face: str = face, q: FloatArray = q) -> FloatArray:
            there = gaps(shape, face, q + shift)
            return np.column_stack([there.distance_m, there.beside_m])

        slopes = np.concatenate([found.normals[:, None], found.beside_slopes], axis=1)
        for axis in range(3):
            shift = step * np.eye(3)[axis]
            np.testing.assert_allclose((moved(shift) - moved(-shift)) / (2 * step), slopes[..., axis], atol=1e-5)
