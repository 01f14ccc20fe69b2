"""Who is alive on a running rig, and how they do."""

from __future__ import annotations

import asyncio
from typing import Final

from rich.console import Group, RenderableType
from rich.text import Text

from rhot.bus import Bus
from rhot.errors import WireError
from rhot.messages import ServiceStatus, decode
from rhot.report.html import figures_table

_MOST_ROWS: Final = 100
"""Services that are shown; a rig has about ten."""


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


def status_table(alive: set[str], statuses: dict[str, ServiceStatus]) -> RenderableType:
    """Return what people read: one row a service, below it what is wrong in whole sentences.

    Names are set as text, not as markup: anybody on the bus may choose one.
    """
    columns = ("service", "state", "out /s", "late", "missed", "invalid", "p50 ms", "p99 ms", "± ms")
    table = figures_table(*columns, names=2)
    trouble: list[RenderableType] = []
    names = sorted(alive | set(statuses))
    for name in names[:_MOST_ROWS]:
        status = statuses.get(name)
        if status is None:
            table.add_row(Text(name), "[yellow]no status[/]", *["–"] * 7)
            continue
        table.add_row(Text(name), status.state if name in alive else "[red]gone[/]", *_cells(status))
        trouble += [Text.assemble((f"{name}: ", "bold"), text) for text in (status.problem, status.last_error) if text]
    if len(names) > _MOST_ROWS:
        trouble.append(Text(f"… and {len(names) - _MOST_ROWS} more: is somebody flooding the bus?", "yellow"))
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
