"""Evaluation on recorded hands; figures are held loosely so that no file is tuned to."""

from __future__ import annotations

import csv
import dataclasses
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from rhot.hand import HandModel
from rhot.rig import HandFile
from rhot.rotations import nearest_rotation
from rhot_ik.finger_chains import FabrikFingers
from rhot_ik.finger_geometry import FingerGeometry
from rhot_ik.fingers import AnalyticFingers

FloatArray = NDArray[np.float64]

MSRA = Path(__file__).resolve().parents[3] / "shared/data/hand_motion/msra14_dev.csv"
CHAIN_STARTS = [17, 1, 5, 9, 13]


@pytest.fixture(scope="module")
def frames() -> FloatArray:
    """(N, 21, 3) metres: wrist, then index, middle, ring, little and thumb from the knuckle outwards."""
    if not MSRA.exists():
        pytest.skip(f"real hand data is absent: {MSRA}")
    with MSRA.open(encoding="utf-8") as file:
        rows = list(csv.reader(file))[1:]
    return np.array([[float(value) for value in row[2:]] for row in rows]).reshape(-1, 21, 3) / 1000.0


@pytest.fixture(scope="module")
def hand(frames: FloatArray) -> tuple[FingerGeometry, FloatArray]:
    """The recorded person's bones, and the chains (N, 5, 4, 3), metres, in the wrist frame with knuckles at rest."""
    chains = np.stack([frames[:, start : start + 4] for start in CHAIN_STARTS], axis=1)
    wrists = frames[:, 0]
    model = HandModel.from_file(HandFile(length_m=0.165), "right")
    bones = np.linalg.norm(np.diff(chains, axis=2), axis=-1).mean(axis=0)
    model = dataclasses.replace(model, bones=bones)
    palm = np.concatenate([wrists[:, None], chains[:, 1:, 0]], axis=1)
    rest = np.concatenate([np.zeros((1, 3)), model.knuckles[1:]])
    rest = rest - rest.mean(axis=0)
    local = np.empty_like(chains)
    for k, points in enumerate(palm):
        R = nearest_rotation((points - points.mean(axis=0)).T @ rest)
        local[k] = (chains[k] - wrists[k]) @ R
    return FingerGeometry.of(model, {}), local - (local[:, :, :1] - model.knuckles[:, None])


@pytest.mark.parametrize("solver", ["analytic", "fabrik"])
def test_middle_joints_of_fast_gestures(hand: tuple[FingerGeometry, FloatArray], solver: str) -> None:
    geometry, truth = hand
    targets = truth[:, :, 3]
    if solver == "analytic":
        angles = AnalyticFingers(geometry).solve(targets).angles
    else:
        chains, found, last = FabrikFingers(geometry), [], np.full((5, 4), 0.3)
        for target in targets[::4]:
            last, _ = chains.solve(target, last, 1e-4, 24)
            found.append(last)
        angles, truth = np.array(found), truth[::4]
    error = np.linalg.norm(geometry.model.finger_chains(angles)[0] - truth, axis=-1)
    # Knuckle to tip of the four long fingers; the tip only reaches as far as the stated limits allow.
    assert np.median(error[:, 1:, 1:3]) < 0.003
    assert np.median(error[:, 1:, 3]) < 0.003
    assert np.median(error[:, 0, 1:3]) < 0.006
