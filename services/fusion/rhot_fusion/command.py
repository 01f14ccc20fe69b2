"""`rhot fusion`."""

from __future__ import annotations

from pathlib import Path

import click

from rhot.cli.options import bus_options, rig_option, tool_bus
from rhot.plugins import load_plugin
from rhot.rig import load_rig
from rhot.service import Service, run_service
from rhot_fusion.service import fusion_service


@click.command()
@click.option("--with-ik", is_flag=True, help="Run ik in this process: points reach it without the router.")
@rig_option
@bus_options
def fusion(with_ik: bool, rig_path: Path, connect: tuple[str, ...], namespace: str | None) -> int:
    """Turn the cameras' markers into points in space, until Ctrl-C.

    Reads rhot/markers/*, publishes rhot/points and answers rhot/clock: this machine's clock is the rig clock.
    """
    rig, bus_config = load_rig(rig_path), tool_bus(rig_path, connect, namespace)
    services: list[Service] = [fusion_service(rig)]
    if with_ik:
        services.append(load_plugin("rhot.services", "ik", "--with-ik", "ik")(rig))
    return run_service(services, bus_config)
