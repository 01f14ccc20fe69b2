"""`rhot truth`."""

from __future__ import annotations

import os
from pathlib import Path

import click

from rhot.cli.options import bus_options, rig_option, tool_bus
from rhot.rig import load_rig
from rhot.service import run_service
from rhot_sim.running.truth import TruthService


@click.command()
@rig_option
@bus_options
def truth(rig_path: Path, connect: tuple[str, ...], namespace: str | None) -> int:
    """Publish rhot/truth, what is true in the simulated world, until Ctrl-C."""
    # It must not disturb what it is there to judge.
    os.nice(5)
    return run_service(TruthService(load_rig(rig_path)), tool_bus(rig_path, connect, namespace))
