"""The processes of a simulated rig: router, services, and how all of them end together."""

from __future__ import annotations

import asyncio
import os
import time
from collections.abc import Awaitable, Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Final

from rhot.bus import Bus
from rhot.errors import BusError
from rhot.operation.status import fetch_status
from rhot.operation.supervisor import Supervisor
from rhot.rig import BusConfig, Rig

_UP_LIMIT_S: Final = 30.0


def service_commands(
    rig: Rig, endpoint: str, names: Iterable[str], pages: Mapping[str, Sequence[str]] | None = None
) -> dict[str, list[str]]:
    """Return the commands that run a rig's capture services and the other services named, by their names on the bus.

    Args:
        rig: loaded.
        endpoint: of the router.
        names: of the services beside capture.
        pages: name on the bus and command of each web page, without the rig's own options.
    """
    options = ["--rig", str(rig.path), "--connect", endpoint]
    services = {f"capture/{name}": ["capture", "--camera", name, *options] for name in rig.config.cameras}
    services |= {f"{name}/main": [name, *options] for name in names}
    return services | {name: [*command, *options] for name, command in (pages or {}).items()}


def bus_of(rig: Rig, endpoint: str) -> BusConfig:
    """Return how this process meets a rig's services at a router: in the namespace that they find for themselves."""
    return BusConfig(connect=(endpoint,), namespace=os.environ.get("RHOT_NAMESPACE") or rig.config.bus.namespace)


async def with_processes(
    bus_config: BusConfig, services: Mapping[str, Sequence[str]], logs: Path, work: Callable[[Bus], Awaitable[None]]
) -> None:
    """Run a router in this process and services beside it, wait until all are there, do the work, end everything.

    Args:
        bus_config: how the services are met, see `bus_of`; the router listens where it connects.
        services: name on the bus and command of each.
        logs: folder for their output.
        work: done while they run.

    Raises:
        RhotError: the router or a service did not come up, or one ended by itself.
    """
    supervisor = Supervisor(logs)
    router = BusConfig(mode="router", connect=(), listen=bus_config.connect)
    try:
        async with await Bus.open(router), await Bus.open(bus_config) as bus:
            for name, arguments in services.items():
                await supervisor.start(name.replace("/", " "), arguments)
            working = asyncio.create_task(_when_up(bus, set(services), work))
            failed = asyncio.create_task(supervisor.wait_for_failure())
            try:
                await asyncio.wait((working, failed), return_when=asyncio.FIRST_COMPLETED)
                if failed.done():
                    raise supervisor.failure(failed.result())
                working.result()
            finally:
                working.cancel()
                failed.cancel()
                await asyncio.gather(working, failed, return_exceptions=True)
    finally:
        await supervisor.stop()


async def _when_up(bus: Bus, wanted: set[str], work: Callable[[Bus], Awaitable[None]]) -> None:
    deadline = time.monotonic() + _UP_LIMIT_S
    while True:
        alive, _ = await fetch_status(bus, timeout_s=0.5)
        if wanted <= alive:
            break
        if time.monotonic() > deadline:
            raise BusError(
                f"{', '.join(sorted(wanted - alive))} did not come up within {_UP_LIMIT_S:.0f} s; is this machine "
                "overloaded?"
            )
        await asyncio.sleep(0.1)
    await work(bus)
