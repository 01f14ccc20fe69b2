"""A rig that is started for as long as something is played to it."""

from __future__ import annotations

import asyncio
import contextlib
import time
from collections.abc import AsyncIterator, Callable

from rhot.bus import CONNECT_S, Bus
from rhot.errors import BusError
from rhot.operation.control import broadcast, newest_control, quickest_exchange
from rhot.operation.status import fetch_status
from rhot.service.clock_sync import serve_clock

_START_DELAY_S = 0.2


async def rig_clock(bus: Bus) -> Callable[[], int]:
    """Return a function that reads rig time; where nobody owns the rig clock, this process takes it over."""
    now_ns, _ = await measured_rig_clock(bus)
    return now_ns


async def measured_rig_clock(bus: Bus) -> tuple[Callable[[], int], float]:
    """Return what `rig_clock` does, and by how many seconds it may be off at most: half the quickest round trip."""
    try:
        best = await quickest_exchange(bus, 0.0)
    except BusError:
        serve_clock(bus)
        return time.time_ns, 0.0
    return lambda: time.monotonic_ns() + best.offset_ns, 0.5e-9 * best.round_trip_ns


@contextlib.asynccontextmanager
async def started(bus: Bus, session: str) -> AsyncIterator[None]:
    """Have all living services run during the block: start them unless they are, and then stop them afterwards."""
    if await _running(bus):
        yield
        return
    await broadcast(bus, "start", session, _START_DELAY_S, CONNECT_S)
    running_limit_s = 5.0
    deadline = time.monotonic() + running_limit_s
    while time.monotonic() < deadline:
        _, statuses = await fetch_status(bus, timeout_s=0.5)
        if all(status.state == "running" and status.session == session for status in statuses.values()):
            break
        await asyncio.sleep(0.1)
    try:
        yield
    finally:
        await broadcast(bus, "stop", session, 0.0, CONNECT_S)


async def _running(bus: Bus) -> bool:
    newest = await newest_control(bus)
    return newest is not None and newest.action == "start"
