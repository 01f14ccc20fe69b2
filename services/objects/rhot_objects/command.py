"""`rhot objects`."""

from __future__ import annotations

from pathlib import Path

import click

from rhot.cli.options import bus_options, rig_option, tool_bus
from rhot.rig import load_rig
from rhot.service import run_service
from rhot_objects.service import ObjectsService


@click.command()
@rig_option
@bus_options
def objects(rig_path: Path, connect: tuple[str, ...], namespace: str | None) -> int:
    """Publish the poses of tracked objects and of the headset, until Ctrl-C.

    Reads SteamVR (or recordings, or the simulated world) and publishes rhot/object/ID and rhot/head in the rig frame.
    """
    return run_service(ObjectsService(load_rig(rig_path)), tool_bus(rig_path, connect, namespace))
