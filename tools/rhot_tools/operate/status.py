"""`rhot status`: which services are alive and how they do."""

from __future__ import annotations

import asyncio
import json
from pathlib import Path

import click
from rich.console import Console

from rhot.bus import Bus
from rhot.cli.options import bus_options, rig_option, tool_bus
from rhot.errors import BusError
from rhot.messages import ServiceStatus
from rhot.operation.status import fetch_status, status_table
from rhot.rig import BusConfig


async def _fetch(config: BusConfig) -> tuple[set[str], dict[str, ServiceStatus]]:
    async with await Bus.open(config, timeout_s=2.0) as bus:
        return await fetch_status(bus)


@click.command()
@click.option("--json", "as_json", is_flag=True, help="Print one JSON object per service instead of the table.")
@rig_option
@bus_options
def status(as_json: bool, rig_path: Path, connect: tuple[str, ...], namespace: str | None) -> None:
    """Show which services are running, with their rates, losses, latency and errors.

    Each row shows the messages published per second, frames dropped as late, frames lost by the source, invalid
    messages rejected, the age of the output when it is sent, and the uncertainty of the clock. Problems are listed
    below the table. --json holds everything that a service reports, such as all counts and the latency of each stage.
    """
    alive, statuses = asyncio.run(_fetch(tool_bus(rig_path, connect, namespace)))
    if not alive and not statuses:
        raise BusError("the router answers, but no service is there; `rhot up` starts the PC side, `rhot sim` a demo")
    if as_json:
        for name, value in sorted(statuses.items()):
            click.echo(json.dumps({"alive": name in alive, **value.model_dump(exclude_none=True)}))
        return
    Console().print(status_table(alive, statuses))
