from __future__ import annotations

import numpy as np
import pytest

from rhot.geometry.rotations import quaternion_from_rotation, rotation_from_quaternion, rotation_from_vector, rotation_x
from rhot_feet.filter.strapdown import SIZE, InertialNoise, InertialState, Strapdown, inject
from rhot_feet.imu.samples import FusedImuConverter, RawImuConverter, level_rotation, up_rotation
from rhot_feet.imu.track import InertialStep

T_NS = np.arange(100) * 10_000_000


def test_up_goes_to_z_and_back() -> None:
    random = np.random.default_rng(0)
    for force in np.concatenate([random.normal(0.0, 5.0, (50, 3)), [[0.0, 1.0, 0.0]]]):
        R = level_rotation(force)
        np.testing.assert_allclose(R @ force, [0.0, 0.0, float(np.linalg.norm(force))], atol=1e-12)
        np.testing.assert_allclose(up_rotation(force) @ [0.0, 0.0, 1.0], force / np.linalg.norm(force), atol=1e-12)
        assert np.linalg.det(R) == pytest.approx(1.0)


def test_fused_sensor_at_rest_feels_gravity_whatever_its_tilt() -> None:
    R = rotation_from_vector(np.array([0.4, -0.9, 2.0]))
    q = np.tile(quaternion_from_rotation(R), (100, 1))
    samples = FusedImuConverter().convert(T_NS, np.zeros((100, 3)), q)
    np.testing.assert_allclose(samples.specific_force, np.tile(R.T @ [0.0, 0.0, 9.81], (100, 1)), atol=1e-12)
    np.testing.assert_allclose(samples.angular_rate, 0.0, atol=1e-9)


def test_fused_rates_go_on_from_call_to_call_but_not_over_gaps() -> None:
    R = np.array([rotation_x(0.03 * k) for k in range(100)])
    q = quaternion_from_rotation(R) * np.where(np.arange(100) % 2, 1.0, -1.0)[:, None]
    converter = FusedImuConverter()
    rates = [converter.convert(T_NS[k : k + 1], np.zeros((1, 3)), q[k : k + 1]).angular_rate[0, 0] for k in range(50)]
    np.testing.assert_allclose(rates[1:], 3.0, atol=1e-6)
    late = converter.convert(T_NS[60:61] + 300_000_000, np.zeros((1, 3)), q[60:61])
    assert late.angular_rate[0, 0] == 0.0


def test_raw_sensor_keeps_level_through_shaking() -> None:
    random = np.random.default_rng(1)
    t = np.arange(4000) / 200.0
    angles = 0.6 * np.sin(2.0 * t)
    R = np.array([rotation_x(angle) for angle in angles])
    rate = np.zeros((4000, 3))
    rate[:, 0] = 1.2 * np.cos(2.0 * t)
    shaking = 3.0 * np.sin(25.0 * t)[:, None] * np.array([1.0, 0.5, 0.0])
    force = np.einsum("nji,nj->ni", R, shaking + np.array([0.0, 0.0, 9.81])) + random.normal(0.0, 0.05, (4000, 3))
    samples = RawImuConverter().convert((t * 1e9).astype(np.int64), force, rate + 0.01)
    tilt = rotation_from_quaternion(samples.orientation_xyzw)[:, 2]
    errors = np.degrees(np.arccos(np.clip((tilt * R[:, 2]).sum(axis=1), -1.0, 1.0)))
    assert errors[2000:].mean() < 3.0


def state_at(random: np.random.Generator) -> InertialState:
    values = random.normal(0.0, 0.3, (6, 3))
    R, M = rotation_from_vector(random.normal(0.0, 1.0, 3)), rotation_from_vector(random.normal(0.0, 1.0, 3))
    return InertialState(values[0], values[1], R, values[2], values[3], values[4], M, np.zeros((SIZE, SIZE)))


def test_covariance_follows_the_nominal_state() -> None:
    """The derivatives of a step, against steps from disturbed states."""
    random = np.random.default_rng(5)
    strapdown = Strapdown(np.array([0.0, -9.81, 0.0]), InertialNoise(*np.zeros(8)))
    state = state_at(random)
    step = InertialStep(0.01, random.normal(0.0, 8.0, 3), random.normal(0.0, 8.0, 3), random.normal(0.0, 0.03, 3))
    after = strapdown.predict(state, step)
    d = 1e-5
    F = np.empty((SIZE, SIZE))
    for k in range(SIZE):
        moved = strapdown.predict(inject(state, d * np.eye(SIZE)[k], state.P), step)
        turned = moved.R @ after.R.T
        remounted = moved.M @ after.M.T
        F[:, k] = (
            np.concatenate(
                [
                    moved.position - after.position,
                    moved.velocity - after.velocity,
                    [turned[2, 1], turned[0, 2], turned[1, 0]],
                    moved.acceleration_bias - after.acceleration_bias,
                    moved.rate_bias - after.rate_bias,
                    moved.lever - after.lever,
                    [remounted[2, 1], remounted[0, 2], remounted[1, 0]],
                ]
            )
            / d
        )
    P = np.diag(random.uniform(0.5, 2.0, SIZE))
    predicted = strapdown.predict(
        InertialState(
            state.position, state.velocity, state.R, state.acceleration_bias, state.rate_bias, state.lever, state.M, P
        ),
        step,
    ).P
    np.testing.assert_allclose(predicted, F @ P @ F.T, atol=2e-3)


def test_a_step_in_parts_is_the_step() -> None:
    random = np.random.default_rng(6)
    strapdown = Strapdown(np.array([0.0, 0.0, -9.81]), InertialNoise())
    state = state_at(random)
    step = InertialStep(0.01, random.normal(0.0, 8.0, 3), random.normal(0.0, 8.0, 3), random.normal(0.0, 0.05, 3))
    whole = strapdown.predict(state, step)
    halves = strapdown.predict(strapdown.predict(state, step.part(0.0, 0.004)), step.part(0.004, 0.01))
    np.testing.assert_allclose(halves.R, whole.R, atol=1e-6)
    np.testing.assert_allclose(halves.velocity, whole.velocity, atol=2e-3)
    np.testing.assert_allclose(halves.position, whole.position, atol=2e-4)
