"""The person's movements: exact lengths, feet that stand still, knees that bend one way, speeds of people."""

from __future__ import annotations

from collections.abc import Callable
from typing import get_args

import numpy as np
import pytest

from rhot.arrays import FloatArray
from rhot.rig.feet_config import WalkProgram
from rhot_sim.walker.foot_path import SIDES
from rhot_sim.walker.person import Person, PersonSample
from rhot_sim.walker.programs import PROGRAMS

MakePerson = Callable[..., Person]
STATIONARY = ("still", "head_moving")


def times(person: Person, step_s: float = 0.025) -> FloatArray:
    """Moments of a whole period and a little of the next."""
    return np.arange(0.0, person.period_s + 0.5, step_s)


def flexion(sample: PersonSample, side: str) -> FloatArray:
    """Bend of a knee, radians, positive the right way: the shank turns backwards about the knee's +X (right) axis."""
    leg = sample.legs[side]  # type: ignore[index]
    thigh, shank = leg.R_thigh, leg.R_shank
    bend: FloatArray = np.arctan2(
        (np.cross(shank[:, :, 1], thigh[:, :, 1]) * thigh[:, :, 0]).sum(axis=1),
        (shank[:, :, 1] * thigh[:, :, 1]).sum(axis=1),
    )
    return bend


def test_the_rig_file_names_the_programs() -> None:
    assert set(get_args(WalkProgram)) == set(PROGRAMS)


@pytest.mark.parametrize("program", PROGRAMS)
@pytest.mark.parametrize(("seed", "height_m"), [(1, 1.5), (2, 1.75), (3, 2.0)])
def test_bones_keep_their_lengths_and_knees_bend_forwards(
    person: MakePerson, program: str, seed: int, height_m: float
) -> None:
    walker = person(program, seed, height_m)
    sample = walker.sample(times(walker))
    for side in SIDES:
        leg, hip, ankle = sample.legs[side], sample.hip_joints[side], sample.ankles[side]
        assert np.abs(np.linalg.norm(leg.knee - hip, axis=1) - walker.body.thigh_m).max() < 1e-9
        # The ankle is where the foot is: the leg reaches it at all times.
        assert np.abs(np.linalg.norm(leg.knee - ankle[:, :3, 3], axis=1) - walker.body.shank_m).max() < 1e-9
        assert np.degrees(flexion(sample, side)).min() > 1.0
        assert leg.knee[:, 1].min() > 0.06
        # The knee turns no more than a right angle from where the toes point.
        assert (leg.R_shank[:, :, 0] * ankle[:, :3, 0]).sum(axis=1).min() > 0.5
        for R in (leg.R_thigh, leg.R_shank, ankle[:, :3, :3], sample.head[:, :3, :3], sample.hips[:, :3, :3]):
            assert np.abs(np.swapaxes(R, 1, 2) @ R - np.eye(3)).max() < 1e-9
            assert np.linalg.det(R).min() > 0.0


@pytest.mark.parametrize("program", PROGRAMS)
def test_speeds_are_those_of_people_and_nothing_jumps(person: MakePerson, program: str) -> None:
    walker = person(program, 4)
    step_s = 0.002
    t = np.arange(2.0, 12.0, step_s)
    head = walker.heads(t)[:, :3, 3]
    assert np.linalg.norm(np.diff(head, axis=0), axis=1).max() / step_s < 2.0
    for side in SIDES:
        ankle = walker.ankles(side, t)[:, :3, 3]
        velocity = np.diff(ankle, axis=0) / step_s
        acceleration = np.diff(velocity, axis=0) / step_s
        assert np.linalg.norm(velocity, axis=1).max() < 5.0
        assert np.linalg.norm(acceleration, axis=1).max() < 80.0
        # Accelerations are continuous: the finer the sampling, the smaller their steps.
        assert np.linalg.norm(np.diff(acceleration, axis=0), axis=1).max() < 8.0


def test_feet_swing_as_fast_as_in_walking(person: MakePerson) -> None:
    for program, slowest in (("walk", 2.0), ("sudden", 3.0)):
        walker = person(program)
        ankle = walker.ankles("left", times(walker, 0.005))[:, :3, 3]
        assert np.linalg.norm(np.diff(ankle, axis=0), axis=1).max() / 0.005 > slowest


@pytest.mark.parametrize("program", PROGRAMS)
def test_a_flat_foot_does_not_move_at_all_and_no_foot_is_under_the_floor(person: MakePerson, program: str) -> None:
    walker = person(program, 5)
    t = times(walker)
    for side in SIDES:
        T = walker.ankles(side, t)
        flat = walker.flat(side, t)
        still = flat[1:] & flat[:-1]
        assert flat.mean() > 0.2
        assert np.array_equal(T[1:][still], T[:-1][still])
        assert np.abs(T[flat, 1, 3] - walker.sole.ankle_height_m).max() < 1e-12
        assert np.abs(T[flat, 1, 1] - 1.0).max() < 1e-12
        for contact in (walker.sole.ball, walker.sole.heel):
            assert (T[:, :3, :3] @ contact + T[:, :3, 3])[:, 1].min() > -0.02
    if program in STATIONARY:
        assert all(walker.flat(side, t).all() for side in SIDES)


def test_feet_roll_over_heel_and_ball(person: MakePerson) -> None:
    walker = person("walk")
    t = times(walker)
    T = walker.ankles("right", t)
    pitch = np.degrees(np.arcsin(np.clip(-T[:, 1, 2], -1.0, 1.0)))
    assert pitch.max() > 10.0
    assert pitch.min() < -25.0


@pytest.mark.parametrize("program", ["walk", "on_spot", "side_steps"])
def test_one_foot_is_on_the_floor_at_all_times(person: MakePerson, program: str) -> None:
    walker = person(program, 6)
    t = times(walker)
    on_floor = np.zeros(len(t), dtype=bool)
    for side in SIDES:
        T = walker.ankles(side, t)
        for contact in (walker.sole.ball, walker.sole.heel):
            on_floor |= (T[:, :3, :3] @ contact + T[:, :3, 3])[:, 1] < 1e-3
    assert on_floor.all()


@pytest.mark.parametrize("program", ["still", "bend_knees", "turn_body", "squat"])
def test_who_stands_on_both_feet_has_the_weight_over_the_middle_of_the_soles(person: MakePerson, program: str) -> None:
    """Nobody stands with the weight over the outer fifths of the soles (King et al. 1994: 60 % of the foot)."""
    walker = person(program, 3)
    t = times(walker, 0.05)
    sample = walker.sample(t)
    ankles = (sample.ankles["left"] + sample.ankles["right"]) / 2.0
    forward = -ankles[:, :3, 2]
    apart = sample.ankles["left"][:, :3, 3] - sample.ankles["right"][:, :3, 3]
    side_by_side = np.abs((apart * forward).sum(axis=1)) < 0.1
    standing = side_by_side & walker.flat("left", t) & walker.flat("right", t)
    before_m = ((centre_of_mass(sample) - ankles[:, :3, 3]) * forward).sum(axis=1)[standing]
    ball_m, heel_m = -float(walker.body.ball_m[2]), walker.body.heel_m
    edge_m = 0.2 * (ball_m + heel_m)
    assert standing.mean() > 0.2
    assert edge_m - heel_m < before_m.min()
    assert before_m.max() < ball_m - edge_m


def centre_of_mass(sample: PersonSample) -> FloatArray:
    """Return (N, 3): segments' masses and centres of de Leva 1996 (men), arms hanging, feet left out."""
    hips, trunk = sample.hips[:, :3, 3], sample.neck - sample.hips[:, :3, 3]
    mass = 43.5 + 6.9 + 9.9
    weighted = mass * hips + (43.5 * 0.55 + 6.9 * 1.15 + 9.9 * 0.5) * trunk
    for side in SIDES:
        knee, ankle = sample.legs[side].knee, sample.ankles[side][:, :3, 3]
        hip = sample.hip_joints[side]
        weighted = weighted + 14.2 * (hip + 0.41 * (knee - hip)) + 4.3 * (knee + 0.44 * (ankle - knee))
        mass += 14.2 + 4.3
    return weighted / mass


def test_a_moment_is_the_same_in_any_company(person: MakePerson) -> None:
    walker, again = person("curve", 7), person("curve", 7)
    t = np.array([31.7, 0.4, 5.5, 5.5])
    together = walker.sample(t)
    for i, at_s in enumerate(t):
        alone = again.sample(np.array([at_s]))
        assert np.array_equal(alone.head[0], together.head[i])
        assert np.array_equal(alone.ankles["left"][0], together.ankles["left"][i])
    assert not np.array_equal(person("curve", 8).sample(t).head, together.head)


def test_the_movements_begin_again_without_a_seam(person: MakePerson) -> None:
    for program in PROGRAMS:
        walker = person(program, 2)
        t = walker.period_s + np.array([-0.001, 0.0, 0.001])
        before, now, after = walker.heads(t)[:, :3, 3]
        assert np.linalg.norm(now - before) < 0.002
        assert np.linalg.norm(after - now) < 0.002


def test_the_camera_mostly_looks_at_the_feet_and_sometimes_away(person: MakePerson) -> None:
    walker = person("walk", 1)
    head = walker.heads(times(walker, 0.1))
    down = np.degrees(np.arcsin(np.clip(head[:, 1, 2], -1.0, 1.0)))
    assert np.median(down) > 50.0
    assert 0.05 < (down < 40.0).mean() < 0.5


def heading(poses: FloatArray) -> FloatArray:
    """Return which way poses (N, 4, 4) face, degrees, to the left positive."""
    angles: FloatArray = np.degrees(np.unwrap(np.arctan2(poses[:, 0, 2], poses[:, 2, 2])))
    return angles


def test_the_straight_line_and_the_circle_are_two_metres_long(person: MakePerson) -> None:
    line, circle = person("line", 3), person("circle", 3)
    middle = np.mean([line.ankles(side, times(line))[:, :3, 3] for side in SIDES], axis=0)
    assert -middle[:, 2].min() == pytest.approx(2.0, abs=0.08)
    assert np.abs(middle[:, 0]).max() < 0.1
    middle = np.mean([circle.ankles(side, times(circle))[:, :3, 3] for side in SIDES], axis=0)
    assert np.ptp(middle[:, 0]) == pytest.approx(2.0, abs=0.1)
    assert np.ptp(middle[:, 2]) == pytest.approx(2.0, abs=0.1)


def test_one_step_brings_both_feet_forward_and_back(person: MakePerson) -> None:
    walker = person("step", 1)
    for side in SIDES:
        ankle = walker.ankles(side, times(walker))[:, :3, 3]
        assert 0.35 < np.ptp(ankle[:, 2]) < 0.8
        assert np.ptp(ankle[:, 0]) < 0.08


def test_knees_bend_and_the_body_turns_over_standing_feet(person: MakePerson) -> None:
    for program in ("bend_knees", "turn_body"):
        walker = person(program, 2)
        t = times(walker)
        for side in SIDES:
            assert walker.flat(side, t).all()
            assert np.ptp(walker.ankles(side, t)[:, :3, 3], axis=0).max() < 1e-9
    bending, turning = (person(program, 2).sample(t) for program in ("bend_knees", "turn_body"))
    assert np.degrees(flexion(bending, "left")).max() > 60.0
    assert np.degrees(flexion(turning, "left")).max() < 40.0
    assert np.ptp(heading(turning.hips)) > 30.0
    assert np.ptp(heading(turning.head)) > 70.0
