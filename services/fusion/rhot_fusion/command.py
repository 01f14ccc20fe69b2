"""`rhot fusion`."""

from __future__ import annotations

from pathlib import Path

import click

from rhot.cli.options import bus_options, rig_option, tool_bus
from rhot.rig import load_rig
from rhot.service import run_service
from rhot_fusion.service import fusion_service


@click.command()
@rig_option
@bus_options
def fusion(rig_path: Path, connect: tuple[str, ...], namespace: str | None) -> int:
    """Turn the cameras' markers into points in space, until Ctrl-C.

    Reads rhot/markers/*, publishes rhot/points and answers rhot/clock: this machine's clock is the rig clock.
    """
    return run_service(fusion_service(load_rig(rig_path)), tool_bus(rig_path, connect, namespace))
