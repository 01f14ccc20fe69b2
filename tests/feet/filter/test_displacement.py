"""Feet that set off unseen: how far, by a sensor whose direction is not known, and without any sensor."""

from __future__ import annotations

import numpy as np
import pytest
from foot_walk import UP, Walk, ns

from rhot.arrays import FloatArray
from rhot.geometry.rotations import quaternion_from_rotation, rotation_between, rotation_from_quaternion
from rhot_feet.filter.foot_filter import FootFilter
from rhot_feet.filter.model import FootFilterSettings, FootState
from rhot_feet.imu.samples import FusedImuConverter

SIGMA_M = 0.002


def filter_of_a_standing_foot() -> FootFilter:
    return FootFilter(FootFilterSettings(up=(float(UP[0]), float(UP[1]), float(UP[2]))))


def hidden_step(
    walk: Walk, until_s: float, *, turned: bool = False, silent_s: tuple[float, float] = (0.0, 0.0)
) -> tuple[list[FootState], FloatArray]:
    """Return states and errors of a foot that stood in sight for a second and then steps unseen.

    Args:
        walk: of the foot.
        until_s: the end.
        turned: its marker showed how it stood.
        silent_s: samples between these moments are lost, and no state is asked for.
    """
    foot, converter, random = filter_of_a_standing_foot(), FusedImuConverter(), np.random.default_rng(5)
    t = np.arange(-1.0, until_s, 0.01)
    accelerations, quaternions = walk.imu(t, 3)
    states, errors_m = [], []
    for k, now in enumerate(t.tolist()):
        if silent_s[0] < now < silent_s[1]:
            continue
        row = slice(k, k + 1)
        foot.add_imu_samples(converter.convert(np.array([ns(now)]), accelerations[row], quaternions[row]))
        position, R = walk.foot(now)
        if now < -0.05:
            orientation = quaternion_from_rotation(R) if turned else None
            seen = position + random.normal(0.0, SIGMA_M, 3)
            foot.update_marker(ns(now), seen, SIGMA_M**2 * np.eye(3), orientation)
        elif now > 0.15:
            state = foot.state(ns(now))
            assert state is not None
            assert not foot.aligned, "one that is aligned is carried by its sensor"
            states.append(state)
            errors_m.append(float(np.linalg.norm(state.position - position)))
    return states, np.array(errors_m)


@pytest.mark.parametrize("stride_m", [0.03, 0.08, 0.5])
def test_a_sensor_without_a_direction_tells_how_far_the_foot_went(stride_m: float) -> None:
    states, error_m = hidden_step(Walk(stride_m=stride_m, height_m=0.02, pitch_rad=0.2), 1.05)
    sigma_m = np.array([state.sigma_m for state in states])
    assert error_m[-1] == pytest.approx(stride_m, rel=0.3), "nobody knows where to, so it stays"
    assert (error_m < 2.0 * sigma_m).all()
    assert sigma_m[-1] < 1.3 * stride_m + 0.05
    # Without a sensor it might be a metre and a half away after a second.
    assert sigma_m[-1] < 0.7


def test_a_lifted_heel_tells_where_an_unseen_foot_goes() -> None:
    walk = Walk(stride_m=0.5, lever=(0.02, -0.05, 0.04))
    states, error_m = hidden_step(walk, 1.05, turned=True)
    sigma_m = np.array([state.sigma_m for state in states])
    assert error_m[-1] < 0.3 * walk.stride_m
    assert (error_m < 2.0 * sigma_m).all()
    assert sigma_m[-1] < 0.4 * walk.stride_m
    turn = rotation_between(rotation_from_quaternion(states[10].orientation_xyzw), walk.foot(0.26)[1])
    assert np.linalg.norm(turn) < 0.3, "how it is turned is known, too"


def test_samples_that_are_lost_while_a_foot_sets_off_are_not_guessed() -> None:
    """One sample taken for all of 140 ms carried feet away at up to 2 m/s, published with 3 cm."""
    states, error_m = hidden_step(Walk(stride_m=0.5), 1.05, turned=True, silent_s=(0.2, 0.34))
    after = np.array([state.t_ns for state in states]) > ns(0.34)
    assert not any(state.followed for state, late in zip(states, after, strict=True) if late)
    assert (error_m < 2.0 * np.array([state.sigma_m for state in states]))[after].all()


def test_lifted_toes_do_not_pass_for_a_lifted_heel() -> None:
    walk = Walk(stride_m=0.5, pitch_rad=-0.9, height_m=0.0, lever=(0.0, 0.0, -0.07), mounting=(0.0, 0.0, 0.0))
    states, error_m = hidden_step(walk, 1.05, turned=True)
    assert error_m[-1] == pytest.approx(walk.stride_m, rel=0.3), "it stays, for the heel would say the opposite"
    assert (error_m < 2.0 * np.array([state.sigma_m for state in states])).all()


def test_how_high_a_foot_is_lifted_is_known_without_a_direction() -> None:
    states, error_m = hidden_step(Walk(stride_m=0.0, height_m=0.3, pitch_rad=0.0), 0.3)
    assert error_m[-1] < 0.03
    assert states[-1].sigma_m < 0.05


def test_what_is_seen_on_the_way_is_where_the_way_goes_on() -> None:
    foot, converter, walk = filter_of_a_standing_foot(), FusedImuConverter(), Walk(stride_m=0.5)
    t = np.arange(-1.0, 0.45, 0.01)
    accelerations, quaternions = walk.imu(t, 3)
    for k, now in enumerate(t.tolist()):
        row = slice(k, k + 1)
        foot.add_imu_samples(converter.convert(np.array([ns(now)]), accelerations[row], quaternions[row]))
        if now < -0.05 or 0.2 < now < 0.25:
            foot.update_marker(ns(now), walk.foot(now)[0], SIGMA_M**2 * np.eye(3))
    state = foot.state(ns(0.44))
    assert state is not None
    assert not foot.aligned
    unseen_m = np.linalg.norm(walk.foot(0.44)[0] - walk.foot(0.24)[0])
    assert state.sigma_m < 1.2 * unseen_m + 0.05, "only what has come since is not known"
    assert np.linalg.norm(state.position - walk.foot(0.44)[0]) < 2.0 * state.sigma_m


def test_samples_that_are_missing_end_what_is_known() -> None:
    foot, converter = filter_of_a_standing_foot(), FusedImuConverter()
    rest = np.zeros((1, 3)), np.array([[0.0, 0.0, 0.0, 1.0]])
    for k in range(40):
        foot.add_imu_samples(converter.convert(np.array([ns(0.01 * k)]), *rest))
        foot.update_marker(ns(0.01 * k), np.zeros(3), SIGMA_M**2 * np.eye(3))
    soon, late = foot.state(ns(0.41)), foot.state(ns(1.4))
    assert soon is not None
    assert late is not None
    assert soon.sigma_m < 0.015
    assert late.sigma_m > 0.5


def test_what_only_setting_off_explains_is_followed_at_once() -> None:
    """A foot that moves slowly, sets off unseen with 20 m/s² and is seen again 0.1 s later."""
    foot, random = filter_of_a_standing_foot(), np.random.default_rng(2)
    slow_m_s, a = 0.35, 20.0
    for k in range(60):
        t = k / 60.0 - 1.0
        foot.update_marker(
            ns(t), np.array([slow_m_s * t, 0.0, 0.0]) + random.normal(0.0, SIGMA_M, 3), SIGMA_M**2 * np.eye(3)
        )
    sigmas = [state.sigma_m for s in (0.0, 0.04, 0.08) if (state := foot.state(ns(-1.0 / 60.0 + s))) is not None]
    assert sigmas[0] < 0.02
    assert sigmas[2] > 0.5 * a * 0.08**2, "it may have set off, and that is said"
    # A shape in the depth picture, 20 mm wrong; the foot is 100 mm away from where it was going.
    seen_s = -1.0 / 60.0 + 0.1
    true = np.array([slow_m_s * seen_s, 0.0, 0.5 * a * 0.1**2])
    seen = true + np.array([0.0, 0.02, 0.0])
    assert foot.update_depth(ns(seen_s), seen, 0.02**2 * np.eye(3))
    state = foot.state(ns(seen_s))
    assert state is not None
    assert np.linalg.norm(state.position - true) < 0.03
    assert state.velocity[2] > 1.0
