"""Waiting for the bus: what one session declares, others know only some moments later."""

from __future__ import annotations

import asyncio
from collections.abc import Callable
from typing import Any

from rhot.bus import Bus, Reply
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
