"""Evaluation on recorded hands; the person is fitted on other frames, and figures are held loosely."""

from __future__ import annotations

import csv
import dataclasses
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest

from rhot.anatomy.hand import HandModel
from rhot.anatomy.skeleton import FINGERS
from rhot.arrays import FloatArray
from rhot.rig import IkConfig, MarkerConfig
from rhot_bench.hands.recorded_hands import (
    fit_person,
    fit_rest_frames,
    fit_spread,
    palm_rotations,
    plain_fingers,
    plain_hand,
)
from rhot_bench.thesis.fabrik import FabrikFingers
from rhot_ik.hand.closed_form import AnalyticFingers, FingerGeometry
from rhot_ik.hand.filter.evidence import HandObservation
from rhot_ik.hand.solver import HandSolver

RATE_HZ = 30.0


@dataclass(frozen=True, slots=True)
class Recorded:
    """Wrists (N, 3) and chains (N, 5, 4, 3), thumb first, metres."""

    wrists: FloatArray
    chains: FloatArray


def read(path: Path, wrist: str) -> Recorded:
    with path.open(encoding="utf-8") as file:
        head, *rows = list(csv.reader(file))
    table = dict(zip(head, np.array(rows, dtype=float).T, strict=True))

    def point(name: str) -> FloatArray:
        return np.stack([table[f"{name}_{axis}"] for axis in "xyz"], axis=-1) / 1000.0

    chains = [np.stack([point(f"{f}_{joint}") for joint in ("mcp", "pip", "dip", "tip")], axis=1) for f in "TIMRP"]
    return Recorded(point(wrist), np.stack(chains, axis=1))


@pytest.fixture(scope="module")
def gestures(shared_data: Path) -> list[tuple[Recorded, Recorded]]:
    """Fast gestures: one half to fit the person on and the other to judge, both ways round."""
    all_frames = read(shared_data / "hand_motion/msra14_dev.csv", "wrist")
    middle = len(all_frames.wrists) // 2
    halves = [
        Recorded(all_frames.wrists[part], all_frames.chains[part]) for part in (slice(middle), slice(middle, None))
    ]
    return [(halves[0], halves[1]), (halves[1], halves[0])]


def on_its_palm(model: HandModel, recorded: Recorded) -> FloatArray:
    """Return chains (N, 5, 4, 3) in the wrist frame, beginning in the model's knuckles."""
    R = palm_rotations(recorded.wrists, recorded.chains, model.knuckles)
    local: FloatArray = (recorded.chains - recorded.wrists[:, None, None]) @ R[:, None]
    local[:, :, 0] = model.knuckles
    return local


def solved(model: HandModel, recorded: Recorded) -> FloatArray:
    """Return chains (N, 5, 4, 3) from wrist and tips alone, metres."""
    bare = dataclasses.replace(model, marker_offsets_m=dict.fromkeys((*FINGERS, "base"), (0.0, 0.0, 0.0)))
    markers = {finger: MarkerConfig(joint=f"{finger}_tip") for finger in FINGERS}
    solver = HandSolver(bare, markers | {"base": MarkerConfig(joint="wrist")}, "base", IkConfig())
    found = []
    for k, (wrist, chains) in enumerate(zip(recorded.wrists, recorded.chains, strict=True)):
        t_ns = 10**18 + round(k / RATE_HZ * 1e9)
        seen = HandObservation(t_ns, wrist, True, None, chains[:, 3], np.ones(5, dtype=bool))
        solution = solver.solve(seen)
        assert solution is not None
        T = solution.T_rig_wrist
        found.append(bare.finger_chains(solution.angles)[0] @ T[:3, :3].T + T[:3, 3])
    return np.array(found)


def error_mm(found: FloatArray, truth: FloatArray, joints: slice) -> float:
    return float(np.linalg.norm(found - truth, axis=-1)[:, :, joints].mean() * 1e3)


def test_middle_joints_on_a_given_palm(gestures: list[tuple[Recorded, Recorded]]) -> None:
    ours: list[float] = []
    default: list[float] = []
    plain: list[float] = []
    for fit, judged in gestures:
        person = fit_person(fit.wrists, fit.chains, "right")
        local, truth = on_its_palm(person, fit), on_its_palm(person, judged)
        bending = fit_spread(fit_rest_frames(person, local), local)
        for model, errors in ((bending, ours), (person, default)):
            angles = AnalyticFingers(FingerGeometry.of(model, {})).solve(truth[:, :, 3]).angles
            errors.append(error_mm(model.finger_chains(angles)[0], truth, slice(1, 3)))
        plain.append(error_mm(plain_fingers(person, truth[:, :, 3]), truth, slice(1, 3)))
    assert np.mean(ours) < 1.8
    assert np.mean(default) < 3.5
    assert np.mean(plain) > 3.0 * np.mean(ours)


def test_the_chain_solver_reaches_the_same(gestures: list[tuple[Recorded, Recorded]]) -> None:
    fit, judged = gestures[0]
    person = fit_person(fit.wrists, fit.chains, "right")
    model = fit_rest_frames(person, on_its_palm(person, fit))
    truth = on_its_palm(person, judged)[::8]
    solver, last, found = FabrikFingers(FingerGeometry.of(model, {})), np.full((5, 4), 0.3), []
    for target in truth[:, :, 3]:
        last, _ = solver.solve(target, last, 1e-4, 24)
        found.append(model.finger_chains(last)[0])
    assert error_mm(np.array(found), truth, slice(1, 3)) < 4.0


def test_middle_joints_from_wrist_and_tips_alone(gestures: list[tuple[Recorded, Recorded]]) -> None:
    ours, plain = [], []
    for fit, judged in gestures:
        person = fit_person(fit.wrists, fit.chains, "right")
        ours.append(error_mm(solved(person, judged), judged.chains, slice(1, 3)))
        chains = zip(judged.wrists, judged.chains[:, :, 3], strict=True)
        found = np.array([plain_hand(person, wrist, tips) for wrist, tips in chains])
        plain.append(error_mm(found, judged.chains, slice(1, 3)))
    assert np.mean(ours) < 7.0
    assert np.mean(plain) > 1.8 * np.mean(ours)


def test_the_thumbs_first_bone_begins_where_its_end_turns(gestures: list[tuple[Recorded, Recorded]]) -> None:
    """The recorded first joint of the thumb lies on the way along that bone and moves by centimetres in the palm."""
    persons = [fit_person(fit.wrists, fit.chains, "right") for fit, _ in gestures]
    assert np.linalg.norm(persons[0].knuckles[0] - persons[1].knuckles[0]) < 0.0005
    for person, (_, judged) in zip(persons, gestures, strict=True):
        R = palm_rotations(judged.wrists, judged.chains, person.knuckles)
        local = (judged.chains[:, 0] - judged.wrists[:, None]) @ R
        reach = np.linalg.norm(local[:, 1] - person.knuckles[0], axis=1)
        assert local[:, 0].std(axis=0).max() > 0.005
        assert np.abs(reach - person.bones[0, 0]).max() < 0.0005


@pytest.mark.parametrize("person", [1, 2, 3])
def test_inner_joints_of_daily_actions(shared_data: Path, person: int) -> None:
    files = sorted((shared_data / "hand_motion/fpha").glob(f"S{person}_*.csv"))
    recordings = [read(path, "W") for path in files]
    fit = Recorded(*(np.concatenate([getattr(r, name)[::5] for r in recordings[::2]]) for name in ("wrists", "chains")))
    model = fit_person(fit.wrists, fit.chains, "right")
    ours, plain = [], []
    for recorded in recordings[1::2]:
        judged = Recorded(recorded.wrists[:50], recorded.chains[:50])
        ours.append(error_mm(solved(model, judged), judged.chains, slice(0, 3)))
        chains = zip(judged.wrists[::5], judged.chains[::5, :, 3], strict=True)
        found = np.array([plain_hand(model, wrist, tips) for wrist, tips in chains])
        plain.append(error_mm(found, judged.chains[::5], slice(0, 3)))
    assert np.mean(plain) > 1.3 * np.mean(ours)
