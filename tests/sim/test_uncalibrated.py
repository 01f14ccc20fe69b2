"""A simulated rig folder: one that somebody is about to calibrate, one of feet, and what it says."""

from __future__ import annotations

import re
from pathlib import Path

import pytest
from click.testing import CliRunner

from rhot.errors import ConfigError
from rhot.rig.folder import load_rig
from rhot_sim.command import sim
from rhot_sim.rig.folder import with_motion
from rhot_sim.running.calibration_run import missing_calibration
from rhot_sim.walker.folder import write_walker_rig
from rhot_sim.world.world import World
from rhot_tools.operate.init import init


def test_it_holds_no_calibration_and_shows_what_it_is_told_to(tmp_path: Path) -> None:
    done = CliRunner().invoke(init, [str(tmp_path / "rig"), "--sim", "--uncalibrated"])
    assert "rhot sim --rig" in done.output
    rig = load_rig(tmp_path / "rig")
    assert [file.name for file in rig.path.iterdir()] == ["rig.toml"]
    assert missing_calibration(rig) == "colors.json, cameras.json"
    for motion in ("board", "desk_board", "script", "still", "touch"):
        rig = with_motion(rig, motion)
        assert (World.from_rig(rig).board is not None) == (motion in ("board", "desk_board"))
    rig.colors_path.write_text("{}")
    assert missing_calibration(rig) == "cameras.json"


def test_a_rig_of_ones_own_is_uncalibrated_anyway(tmp_path: Path) -> None:
    refused = CliRunner().invoke(init, [str(tmp_path / "rig"), "--uncalibrated"])
    assert isinstance(refused.exception, ConfigError)
    assert not (tmp_path / "rig").exists()
    with pytest.raises(ConfigError, match="--sim"):
        raise refused.exception


def test_a_simulated_person_is_a_rig_of_feet(tmp_path: Path) -> None:
    done = CliRunner().invoke(init, [str(tmp_path / "rig"), "--sim", "--feet"])
    assert "rhot sim --rig" in done.output
    rig = load_rig(tmp_path / "rig")
    assert not rig.config.cameras
    assert rig.config.feet is not None
    assert rig.config.feet.camera.source == "simulated"
    assert isinstance(CliRunner().invoke(init, [str(tmp_path / "own"), "--feet"]).exception, ConfigError)


@pytest.mark.parametrize(
    ("options", "says"),
    [
        (["--rate", "30"], "--rate: .* says that"),
        (["--walk", "line"], 'write walk = "line" under'),
        (["--seed", "5"], "write seed = 5 under"),
        (["--motion", "headset"], 'write motion = "headset" under'),
    ],
)
def test_what_the_rig_folder_says_is_not_ignored_in_silence(tmp_path: Path, options: list[str], says: str) -> None:
    write_walker_rig(tmp_path / "rig")
    refused = CliRunner().invoke(sim, ["--rig", str(tmp_path / "rig"), *options])
    assert isinstance(refused.exception, ConfigError)
    assert re.search(says, str(refused.exception))
