"""What `rhot doctor` says about the floor: an honest one passes, and each way to be wrong is told."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from bus_watch import settled

from rhot.bus import Bus
from rhot.geometry.rotations import rigid, rotation_x
from rhot.messages import HandPose, Joint
from rhot.rig import BusConfig, RegistrationFile, Rig, RigidTransform, StageFile, load_rig, write_json_model
from rhot_tools.operate.doctor import check_hands, check_stage

DESK_Z_M, DESK_HEIGHT_M = 0.85, 0.74
TRUE = rigid(
    np.array([[-1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, -1.0, 0.0]]), np.array([0.0, 0.0, DESK_Z_M + DESK_HEIGHT_M])
)
"""Cameras look straight down; the person looks down the picture."""
UPSIDE_DOWN = TRUE @ rigid(rotation_x(np.pi), np.zeros(3))
TILTED = TRUE @ rigid(rotation_x(np.radians(5.0)), np.zeros(3))
IN_THE_CELLAR = TRUE @ rigid(np.eye(3), np.array([0.0, -4.0, 0.0]))


def with_stage(folder: Path, T_rig_stage: np.ndarray[tuple[int, int], np.dtype[np.float64]]) -> Rig:
    stage = StageFile(
        date="2026-01-01",
        T_rig_stage=RigidTransform.from_matrix(T_rig_stage),
        source="desk board",
        residual_m=0.002,
        desk_height_m=DESK_HEIGHT_M,
    )
    write_json_model(folder / "stage.json", stage)
    return load_rig(folder)


def test_no_floor_is_a_note_that_names_the_command(rig_folder: Path) -> None:
    (finding,) = check_stage(load_rig(rig_folder))
    assert finding.level == "note"
    assert f"rhot calibrate stage --live --board 9x6 --square-mm 25 --desk-mm 740 --rig {rig_folder}" in finding.remedy


def test_a_true_floor_passes(rig_folder: Path) -> None:
    (finding,) = check_stage(with_stage(rig_folder, TRUE))
    assert finding.level == "ok"
    assert finding.text == "stage.json: of 2026-01-01, by desk board, residual 2.0 mm"


@pytest.mark.parametrize(
    ("T_rig_stage", "says"),
    [(UPSIDE_DOWN, "camera left would be -1.59 m"), (IN_THE_CELLAR, "camera left would be 5.59 m")],
)
def test_an_impossible_floor_is_told(
    rig_folder: Path, T_rig_stage: np.ndarray[tuple[int, int], np.dtype[np.float64]], says: str
) -> None:
    findings = list(check_stage(with_stage(rig_folder, T_rig_stage)))
    assert {finding.level for finding in findings} == {"warn"}
    assert says in findings[0].text


def test_two_floors_that_disagree_are_told(rig_folder: Path) -> None:
    registration = RegistrationFile(T_rig_tracker=RigidTransform.from_matrix(TRUE))
    write_json_model(rig_folder / "registration.json", registration)
    (fine,) = check_stage(with_stage(rig_folder, TRUE @ rigid(np.eye(3), np.array([0.5, 0.02, 0.3]))))
    assert fine.level == "ok"
    (tilted,) = check_stage(with_stage(rig_folder, TILTED))
    assert "5.0° tilted" in tilted.text
    (low,) = check_stage(with_stage(rig_folder, TRUE @ rigid(np.eye(3), np.array([0.0, 0.2, 0.0]))))
    assert "20 cm lower" in low.text


@pytest.mark.parametrize(("z_m", "level"), [(0.70, "ok"), (0.95, "warn"), (-0.60, "warn")])
async def test_hands_are_where_hands_can_be(rig_folder: Path, router: BusConfig, z_m: float, level: str) -> None:
    rig = with_stage(rig_folder, TRUE)
    wrist = Joint(position=(0.0, 0.0, z_m), orientation=(0.0, 0.0, 0.0, 1.0), radius=0.02)
    hand = HandPose(
        t_ns=1, side="right", frame="rig", joints={"wrist": wrist}, angles={}, residual={}, state="measured"
    )
    async with await Bus.open(router) as bus, await Bus.open(router) as asking:
        bus.publisher("rhot/hand/right", HandPose).put(hand)
        await settled(bus)
        (finding,) = await check_hands(asking, rig)
    assert finding.level == level
    assert f"{DESK_Z_M + DESK_HEIGHT_M - z_m:.2f} m over the floor" in finding.text
