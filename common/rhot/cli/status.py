"""`rhot status`: which services are alive and how they do."""

from __future__ import annotations

import asyncio
import json
from pathlib import Path

import click
from rich import box
from rich.console import Console, Group, RenderableType
from rich.table import Table
from rich.text import Text

from rhot.bus import Bus
from rhot.cli.options import bus_options, rig_option, tool_bus
from rhot.errors import BusError, WireError
from rhot.messages import ServiceStatus, decode
from rhot.rig import BusConfig


async def fetch_status(bus: Bus, timeout_s: float = 1.0) -> tuple[set[str], dict[str, ServiceStatus]]:
    """Return who is alive and the last status of each, both by `service/instance`."""
    alive, replies = await asyncio.gather(
        bus.who_is_alive(timeout_s=timeout_s), bus.get("rhot/status/**", timeout_s=timeout_s)
    )
    statuses: dict[str, ServiceStatus] = {}
    for reply in replies:
        try:
            statuses[reply.key.removeprefix("rhot/status/")] = decode(reply.payload, ServiceStatus)
        except WireError:
            continue
    return {reply.key.removeprefix("rhot/alive/") for reply in alive if reply.key}, statuses


async def _fetch(config: BusConfig) -> tuple[set[str], dict[str, ServiceStatus]]:
    async with await Bus.open(config, timeout_s=2.0) as bus:
        return await fetch_status(bus)


def status_table(alive: set[str], statuses: dict[str, ServiceStatus]) -> RenderableType:
    """Return what people read: one row a service, below it what is wrong in whole sentences."""
    table = Table(header_style="bold", box=box.SIMPLE_HEAD, show_edge=False, padding=(0, 1, 0, 0))
    for column in ("service", "state", "out /s", "late", "missed", "invalid", "p50 ms", "p99 ms", "± ms"):
        table.add_column(column, justify="left" if column in ("service", "state") else "right", no_wrap=True)
    trouble: list[RenderableType] = []
    for name in sorted(alive | set(statuses)):
        status = statuses.get(name)
        if status is None:
            table.add_row(name, "[yellow]new[/]", *["–"] * 7)
            continue
        table.add_row(name, status.state if name in alive else "[red]gone[/]", *_cells(status))
        trouble += [Text.assemble((f"{name}: ", "bold"), text) for text in (status.problem, status.last_error) if text]
    return Group(table, *trouble)


def _cells(status: ServiceStatus) -> list[str]:
    rates, counts, age = status.rates, status.counts, status.latency_s.get("output_age", {})
    uncertainty = status.clock_uncertainty_s
    return [
        f"{rates.get('output', rates.get('frames', 0.0)):.1f}",
        str(counts.get("dropped_late", 0)),
        str(counts.get("missed", 0)),
        str(counts.get("invalid", 0)),
        *(f"{1e3 * age[key]:.1f}" if key in age else "–" for key in ("p50", "p99")),
        "[yellow]unknown[/]" if uncertainty is None else f"{1e3 * uncertainty:.2f}",
    ]


@click.command()
@click.option("--json", "as_json", is_flag=True, help="Print one JSON object a service instead of the table.")
@rig_option
@bus_options
def status(as_json: bool, rig_path: Path, connect: tuple[str, ...], namespace: str | None) -> None:
    """Show which services are alive and how they do.

    A row says how many messages a service publishes per second, how many frames it dropped as late, how many its source
    lost, how many invalid messages it refused, how old its output is when it leaves, and how well it knows rig time.
    What is wrong stands below the table. Everything that a service tells, such as all counts and the latency of each
    stage, is in --json.
    """
    alive, statuses = asyncio.run(_fetch(tool_bus(rig_path, connect, namespace)))
    if not alive and not statuses:
        raise BusError("the router answers, but no service is there; `rhot up` starts the PC side, `rhot sim` a demo")
    if as_json:
        for name, value in sorted(statuses.items()):
            click.echo(json.dumps({"alive": name in alive, **value.model_dump(exclude_none=True)}))
        return
    Console().print(status_table(alive, statuses))
