"""`rhot calibrate stage` and the page's step, over rendered pictures of a board on the desk."""

from __future__ import annotations

import shutil
from functools import partial
from pathlib import Path

import numpy as np
import pytest
from bus_watch import settled
from click.testing import CliRunner, Result

from rhot.bus import Answer, Bus
from rhot.calibration_step import StepContext
from rhot.cli.main import main
from rhot.errors import BusError, ConfigError
from rhot.geometry.rotations import inverse
from rhot.rig import BusConfig, Rig, StageFile, load_rig, read_json_model
from rhot_calibration.stage.page_step import StageStep
from rhot_sim.rig.folder import true_stage

BOARD = ("--board", "9x6", "--square-mm", "25", "--desk-mm", "740")


def run(*arguments: object) -> Result:
    return CliRunner().invoke(main, ["-q", "calibrate", "stage", *map(str, arguments)])


def own_rig(rig: Rig, folder: Path) -> Path:
    shutil.copytree(rig.path, folder)
    return folder


def check_against_truth(stage: StageFile, rig: Rig) -> None:
    off = inverse(true_stage(rig.config.sim)) @ stage.T_rig_stage.matrix
    assert abs(off[1, 3]) < 0.012, "the floor is elsewhere"
    assert np.degrees(np.arccos(off[1, 1])) < 0.7, "up is tilted"
    assert off[2, 2] > 0.99, "forward is elsewhere"
    assert off[0, 0] > 0.99
    assert stage.residual_m is not None
    assert 0.0 < stage.residual_m < 0.01


def test_pictures_of_a_board_on_the_desk(desk_pictures: tuple[Rig, Path], tmp_path: Path) -> None:
    rig, pictures = desk_pictures
    path = own_rig(rig, tmp_path / "rig")
    tried = run(pictures, *BOARD, "--rig", path, "--dry-run")
    assert tried.exit_code == 0, tried.output
    assert not (path / "stage.json").exists()
    done = run(pictures, *BOARD, "--rig", path)
    assert done.exit_code == 0, done.output
    assert "camera left" in done.output
    stage = load_rig(path).stage
    assert stage is not None
    assert (stage.source, stage.desk_height_m) == ("desk board", 0.74)
    check_against_truth(stage, rig)
    assert run(pictures, *BOARD[:-1], "800", "--rig", path).exit_code == 0
    assert read_json_model(path / "stage.previous.json", StageFile) == stage


def test_the_registered_space_is_the_stage(desk_pictures: tuple[Rig, Path], tmp_path: Path) -> None:
    rig, _ = desk_pictures
    path = own_rig(rig, tmp_path / "rig")
    assert run("--registration", "--rig", path).exit_code == 0
    stage = load_rig(path).stage
    assert stage is not None
    assert stage.T_rig_stage == rig.registration.T_rig_tracker
    off = inverse(true_stage(rig.config.sim)) @ stage.T_rig_stage.matrix
    np.testing.assert_allclose(off[1], (0.0, 1.0, 0.0, 0.0), atol=1e-9)
    (path / "registration.json").unlink()
    refused = run("--registration", "--rig", path)
    assert refused.exit_code == 1
    assert "registration.steamvr.json is not there" in refused.output


@pytest.mark.parametrize(
    ("arguments", "says"),
    [
        ((), "give one of"),
        (("--live", "--registration"), "give one of"),
        (("--live",), "--desk-mm"),
        (("--live", "--board", "9x6", "--square-mm", "25"), "--desk-mm"),
    ],
)
def test_what_is_missing_is_named(desk_pictures: tuple[Rig, Path], arguments: tuple[str, ...], says: str) -> None:
    refused = run(*arguments, "--rig", desk_pictures[0].path)
    assert refused.exit_code == 2
    assert says in refused.output


def test_a_height_in_centimetres_is_refused(desk_pictures: tuple[Rig, Path]) -> None:
    refused = run("--live", *BOARD[:-1], "74", "--rig", desk_pictures[0].path)
    assert refused.exit_code == 2
    assert "300" in refused.output


async def test_the_page_looks_tries_and_saves(
    desk_pictures: tuple[Rig, Path], tmp_path: Path, router: BusConfig
) -> None:
    rig, pictures = desk_pictures
    path = own_rig(rig, tmp_path / "rig")
    step = StageStep(StepContext(path, router))
    values = {field.name: field.value for field in step.fields}
    assert not step.view().done
    with pytest.raises(ConfigError, match="desk"):
        await step.press("look", values)
    values["desk_mm"] = "740"
    with pytest.raises(BusError, match="no camera gives a picture"):
        await step.press("look", values)
    async with await Bus.open(router) as bus:
        for name in ("left", "right"):
            answer = Answer((pictures / name / "000001.png").read_bytes(), "image/png")
            bus.queryable(f"rhot/preview/{name}", partial(lambda answer, _: answer, answer), slow=True)
        await settled(bus)
        await step.press("look", values)
    assert "try" in step.view().enabled
    await step.press("try", values)
    await step.press("save", values)
    assert step.view().done
    stage = load_rig(path).stage
    assert stage is not None
    check_against_truth(stage, rig)
    await step.press("registered", values)
    await step.press("try", values)
    assert read_json_model(path / "stage.json", StageFile).source == "steamvr registration"
    await step.press("undo", values)
    assert read_json_model(path / "stage.json", StageFile) == stage
