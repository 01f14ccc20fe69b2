"""`rhot ik`."""

from __future__ import annotations

from pathlib import Path

import click

from rhot.cli.options import bus_options, rig_option, tool_bus
from rhot.rig import load_rig
from rhot.service import run_service
from rhot_ik.service import ik_service


@click.command()
@rig_option
@bus_options
def ik(rig_path: Path, connect: tuple[str, ...], namespace: str | None) -> int:
    """Turn points into a hand with all its joints, until Ctrl-C.

    Reads rhot/points and publishes rhot/hand/left and rhot/hand/right; from head and feet also rhot/body.
    """
    return run_service(ik_service(load_rig(rig_path)), tool_bus(rig_path, connect, namespace))
