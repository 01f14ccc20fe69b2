"""A simulated rig without the time that calibrating its colours takes."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import click
import pytest
from click.testing import CliRunner

from rhot.rig import load_rig, write_json_model
from rhot.rig.colors import nominal_colors
from rhot_bench.speed.scaling import bare_rig
from rhot_sim.world.paint import paints_of

Invoke = Callable[..., str]


@pytest.fixture(scope="session")
def rig_path(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A simulated rig whose colours are those of the paints, without a calibration of them."""
    rig = bare_rig(tmp_path_factory.mktemp("bench") / "rig", 2, 1)
    paints = paints_of(list(rig.config.markers))
    colors = nominal_colors({name: (red, green, blue) for name, (blue, green, red) in paints.items()})
    write_json_model(rig.colors_path, colors)
    return load_rig(rig.path).path


@pytest.fixture
def invoke() -> Invoke:
    """Run a command and return what it printed on standard output; its errors are raised."""

    def run(command: click.Command, *arguments: Any) -> str:
        done = CliRunner(env={"COLUMNS": "140"}).invoke(
            command, [str(argument) for argument in arguments], catch_exceptions=False, standalone_mode=False
        )
        if done.exception is not None:
            raise done.exception
        return done.stdout

    return run
