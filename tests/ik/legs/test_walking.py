"""Legs of the simulated person from the true head and feet, and of real walkers with trackers on waist and feet."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from rhot.anatomy.body_proportions import BodyModel
from rhot.arrays import FloatArray
from rhot.geometry.rotations import rigid, rotation_from_quaternion
from rhot.messages import Side
from rhot.rig import BodyConfig
from rhot_ik.body_core import BodySolution, solve_body
from rhot_ik.legs.hips import Ankle, estimate_hips
from rhot_sim.walker.person import Person
from rhot_sim.walker.programs import PROGRAMS

UP = np.array([0.0, 1.0, 0.0])
RATE_HZ = 15.0


def solve_program(program: str, height_m: float, seed: int) -> tuple[FloatArray, FloatArray, list[BodySolution]]:
    """Return errors of the knees (N, 2) and of the hips (N,), metres, and the solutions of ten seconds."""
    body = BodyModel.from_config(BodyConfig(height_m=height_m))
    person = Person(seed, body, program, np.radians(20.0))
    t_s = np.arange(0.0, min(10.0, person.period_s), 1.0 / RATE_HZ)
    true = person.sample(t_s)
    solutions, knees, hips = [], [], []
    for i in range(len(t_s)):
        ankles = {side: Ankle(poses[i]) for side, poses in true.ankles.items()}
        T_rig_hips = estimate_hips(true.head[i], ankles, UP, body)
        solution = solve_body(T_rig_hips, ankles, body)
        solutions.append(solution)
        hips.append(np.linalg.norm(T_rig_hips[:3, 3] - true.hips[i, :3, 3]))
        knees.append([np.linalg.norm(leg.knee - true.legs[side].knee[i]) for side, leg in solution.legs.items()])
    return np.array(knees), np.array(hips), solutions


@pytest.mark.parametrize("height_m", [1.50, 1.75, 2.00])
@pytest.mark.parametrize("program", ["walk", "curve", "side_steps", "on_spot"])
def test_knees_of_walkers(program: str, height_m: float) -> None:
    knees, hips, solutions = solve_program(program, height_m, 4)
    assert knees.mean() < 0.030
    assert hips.mean() < 0.040
    assert all(leg.knee_flexion_rad >= 0.0 for solution in solutions for leg in solution.legs.values())


@pytest.mark.parametrize("program", sorted(PROGRAMS))
def test_no_posture_bends_a_knee_backwards_or_tears_a_leg(program: str) -> None:
    knees, _, solutions = solve_program(program, 1.7, 5)
    assert knees.mean() < 0.060
    for solution in solutions:
        for side, leg in solution.legs.items():
            assert np.isfinite(solution.joints[f"{side}_knee"]).all()
            front = np.cross(solution.joints["hips"][:3, 0], leg.ankle - leg.hip)
            middle = (leg.hip + leg.ankle) / 2.0
            assert (leg.knee - middle) @ front > -0.02, "the knee is before the leg, seen from the hips"


def recorded_walk(path: Path) -> tuple[FloatArray, dict[Side, FloatArray]]:
    """Return hips (N, 3) and ankles side to (N, 4, 4) of a walker with trackers; y is up, the way goes to −z.

    How the trackers sit on the feet is not recorded: a foot's axes are its tracker's turned so that, on average, they
    are level and straight ahead while the foot stands, which is when it is low.
    """
    rows = np.genfromtxt(path, delimiter=",", names=True)
    hips = np.stack([rows[f"waist_p{axis}"] for axis in "xyz"], axis=-1) - [0.0, 0.10, 0.0]
    ankles: dict[Side, FloatArray] = {}
    sides: tuple[tuple[Side, str], ...] = (("left", "lfoot"), ("right", "rfoot"))
    for side, foot in sides:
        position = np.stack([rows[f"{foot}_p{axis}"] for axis in "xyz"], axis=-1)
        R = rotation_from_quaternion(np.stack([rows[f"{foot}_q{axis}"] for axis in "xyzw"], axis=-1))
        stands = position[:, 1] < np.percentile(position[:, 1], 30.0)
        u, _, vt = np.linalg.svd(R[stands].mean(axis=0))
        mounted = u @ np.diag([1.0, 1.0, np.linalg.det(u @ vt)]) @ vt
        ankles[side] = np.stack([rigid(turn @ mounted.T, spot) for turn, spot in zip(R, position, strict=True)])
    return hips, ankles


@pytest.mark.parametrize("name", ["HW3003_0.5", "HW3006_1.5", "HW3008_1.0"])
def test_real_walks_never_bend_a_knee_backwards_or_jump(shared_data: Path, name: str) -> None:
    hips, ankles = recorded_walk(shared_data / "vive_tracker" / f"{name}.csv")
    body = BodyModel.from_config(BodyConfig(height_m=1.80))
    knees, flexions = [], []
    for i in range(len(hips)):
        T_rig_hips = rigid(np.eye(3), hips[i])
        solution = solve_body(T_rig_hips, {side: Ankle(poses[i]) for side, poses in ankles.items()}, body)
        for side, leg in solution.legs.items():
            front = np.cross(solution.joints["hips"][:3, 0], leg.ankle - leg.hip)
            assert (leg.knee - (leg.hip + leg.ankle) / 2.0) @ front >= -1e-9, f"{name} sample {i}, {side}"
        knees.append([solution.legs[side].knee for side in ankles])
        flexions.append([solution.legs[side].knee_flexion_rad for side in ankles])
    steps = np.linalg.norm(np.diff(np.array(knees), axis=0), axis=-1)
    # A walker's knee moves at up to about 4 m/s, which is 45 mm between two samples at 88 Hz.
    assert steps.max() < 0.045
    assert np.degrees(np.percentile(flexions, 95.0)) > 40.0, "the legs really bend in their swing"
