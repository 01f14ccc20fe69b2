"""`rhot status`: which services are alive and how they do."""

from __future__ import annotations

import asyncio
import json
from pathlib import Path

import click
from rich.console import Console
from rich.table import Table

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


def status_table(alive: set[str], statuses: dict[str, ServiceStatus]) -> Table:
    """Return the table that people read."""
    table = Table(title="Services", title_justify="left", header_style="bold")
    for column in (
        "service",
        "state",
        "session",
        "rates /s",
        "counts, figures",
        "age p50/p99 ms",
        "clock ± ms",
        "trouble",
    ):
        table.add_column(column, overflow="fold")
    for name in sorted(alive | set(statuses)):
        status = statuses.get(name)
        if status is None:
            table.add_row(name, "[yellow]alive, no status yet[/]", *[""] * 6)
            continue
        state = status.state if name in alive else "[red]gone[/]"
        rates = "\n".join(f"{key} {value:.1f}" for key, value in sorted(status.rates.items()))
        ticked = set(status.rates)
        counts = "\n".join(
            f"{key} {value}" for key, value in sorted(status.counts.items()) if value and key not in ticked
        )
        ages = "\n".join(
            f"{stage} {1e3 * p['p50']:.1f}/{1e3 * p['p99']:.1f}" for stage, p in sorted(status.latency_s.items())
        )
        uncertainty = status.clock_uncertainty_s
        clock = "[yellow]unknown[/]" if uncertainty is None else f"{1e3 * uncertainty:.2f}"
        figures = "\n".join(f"{key} {value:.2f}" for key, value in sorted(status.figures.items()))
        trouble = "\n".join(text for text in (status.problem, status.last_error) if text)
        table.add_row(
            name, state, status.session, rates, "\n".join(filter(None, (counts, figures))), ages, clock, trouble
        )
    return table


@click.command()
@click.option("--json", "as_json", is_flag=True, help="Print one JSON object a service instead of the table.")
@rig_option
@bus_options
def status(as_json: bool, rig_path: Path, connect: tuple[str, ...], namespace: str | None) -> None:
    """Show which services are alive and how they do: state, rates, drops, latency, clock, last error."""
    alive, statuses = asyncio.run(_fetch(tool_bus(rig_path, connect, namespace)))
    if not alive and not statuses:
        raise BusError("the router answers, but no service is there; `rhot up` starts the PC side, `rhot sim` a demo")
    if as_json:
        for name, value in sorted(statuses.items()):
            click.echo(json.dumps({"alive": name in alive, **value.model_dump(exclude_none=True)}))
        return
    Console().print(status_table(alive, statuses))
