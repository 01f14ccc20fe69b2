"""Waiting for the bus: what one session declares, others know only some moments later."""

from __future__ import annotations

import asyncio
from collections.abc import Callable
from typing import Any

from rhot.bus import Bus, Reply
from rhot.messages import ServiceStatus, decode
from rhot.operation.status import fetch_status
from rhot.rig import BusConfig

PATIENCE_S = 60.0
"""How long anything may take on a busy machine: nothing here is about speed."""


async def until(condition: Callable[[], Any]) -> None:
    """Wait until a condition holds."""
    async with asyncio.timeout(PATIENCE_S):
        while not condition():
            await asyncio.sleep(0.005)


async def settled(bus: Bus) -> None:
    """Wait until the router knows what a session has declared: it answers a question on the same link after that."""
    await bus.who_is_alive("rhot/alive/nobody", timeout_s=PATIENCE_S)


async def answers(asker: Bus, selector: str) -> list[Reply]:
    """Ask until somebody answers."""
    async with asyncio.timeout(PATIENCE_S):
        while not (replies := await asker.get(selector, timeout_s=PATIENCE_S)):
            await asyncio.sleep(0.001)
    return replies


async def until_known(router: BusConfig, service: str) -> None:
    """Wait until the router tells others of the service (`kind/instance`): that it is alive, and its status."""
    async with await Bus.open(router) as asker, asyncio.timeout(PATIENCE_S):
        while True:
            alive, statuses = await fetch_status(asker)
            if service in alive and service in statuses:
                return
            await asyncio.sleep(0.001)


async def status_of(bus: Bus, service: str) -> ServiceStatus | None:
    """Return what a service (`kind/instance`) told of itself last; None when it does not answer."""
    replies = await bus.get(f"rhot/status/{service}", timeout_s=1.0)
    return decode(replies[0].payload, ServiceStatus) if replies and not replies[0].error else None


async def wait_for_status(bus: Bus, service: str, wanted: Callable[[ServiceStatus], bool]) -> ServiceStatus:
    """Ask a service (`kind/instance`) until its status is as wanted, and return that."""
    async with asyncio.timeout(PATIENCE_S):
        while True:
            status = await status_of(bus, service)
            if status is not None and wanted(status):
                return status
            await asyncio.sleep(0.02)
