"""`rhot up`: everything that runs on the PC, in one terminal."""

from __future__ import annotations

import asyncio
import importlib.util
import logging
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import click

from rhot.bus import Bus
from rhot.cli.options import bus_options, rig_option, tool_bus
from rhot.cli.page import Pages, free_pages, page_options
from rhot.errors import BusError
from rhot.operation.control import broadcast, new_session
from rhot.operation.supervisor import Supervisor
from rhot.rig import BusConfig, load_rig
from rhot.rig.config import RigConfig
from rhot.service.stop import install_stop
from rhot_tools.operate.findings import is_local

logger = logging.getLogger(__name__)

_RIG_TIMEOUT_S = 600.0
"""Seven interpreters start on an emulated machine; what cannot come up at all ends by itself and says so at once."""


@click.command()
@click.option("--no-start", is_flag=True, help="Do not send the start signal; wait for `rhot start`.")
@click.option(
    "--one-process", is_flag=True, help="Run fusion and ik in one process: a hop less, but one core for both."
)
@page_options
@rig_option
@bus_options
def up(
    no_start: bool,
    one_process: bool,
    viewer: bool,
    page_port: int,
    rig_path: Path,
    connect: tuple[str, ...],
    namespace: str | None,
) -> int:
    """Run router, fusion, ik, objects, feet and the web pages on this machine, and start the rig. Ctrl-C stops all.

    Bridges to other programs that rig.toml names as [bridges.NAME] run too, and so do USB cameras, where the router
    listens to this machine only. On Pis the capture services run by themselves (rhot capture --camera NAME) and connect
    automatically. If a router is already running, it is used; if another rig is already active on it, this command
    exits with an error. With --connect, a router must be running. A service that exits unexpectedly is restarted.
    """
    pages = free_pages(page_port) if viewer else Pages()
    bus_config = tool_bus(rig_path, connect, namespace)
    # The environment reaches the services by itself, what was typed does not.
    options = ["--rig", str(rig_path), *(f"--connect={each}" for each in connect)]
    options += [] if namespace is None else [f"--namespace={namespace}"]
    return asyncio.run(
        _up(
            rig_path,
            bus_config,
            options,
            pages,
            start=not no_start,
            one_process=one_process,
            elsewhere=bool(connect),
        )
    )


def _services(config: RigConfig, *, one_process: bool) -> dict[str, list[str]]:
    """Return the commands of the services that a rig needs on the PC, by their names."""
    together = one_process and bool(config.cameras)
    services = {
        "fusion": ["fusion", "--with-ik"] if together else ["fusion"],
        "ik": ["ik"],
        "objects": ["objects"],
        "feet": ["feet"],
    }
    wanted = {"fusion": config.cameras, "ik": not together, "objects": config.objects, "feet": config.feet}
    return {name: command for name, command in services.items() if wanted[name]}


async def _up(
    rig_path: Path,
    bus_config: BusConfig,
    options: Sequence[str],
    pages: Pages,
    *,
    start: bool,
    one_process: bool,
    elsewhere: bool,
) -> int:
    """Run it all; `elsewhere`: at a router that is not this rig's own."""
    rig = load_rig(rig_path)
    stop = install_stop()
    supervisor = Supervisor()
    # On their own: the page and other programs are for looking, and tracking goes on without them.
    beside, bridges = Supervisor(), Supervisor()
    cameras: list[Supervisor] = []
    watching: list[asyncio.Task[Any]] = []
    try:
        alive = await _alive(bus_config)
        if alive is None and elsewhere:
            raise BusError(
                f"no Zenoh router answers at {', '.join(bus_config.connect)}; start it, or leave --connect out"
            )
        if alive is None:
            await supervisor.start("router", ["router", *options])
        _refuse_second_rig(alive or set(), bus_config)
        for name, command in _services(rig.config, one_process=one_process).items():
            await supervisor.start(name, [*command, *options])
        for name, command in pages.commands().items():
            await beside.start(name.replace("/", " "), [*command, *options])
        for name in cameras_here(rig.config, bus_config):
            if f"capture/{name}" not in (alive or set()):
                cameras.append(Supervisor())
                await cameras[-1].start(f"capture {name}", ["capture", f"--camera={name}", *options])
                watching.append(asyncio.create_task(_keep(cameras[-1], f"camera {name}")))
        if rig.config.bridges:
            await bridges.start("bridge", ["bridge", *options])
            watching.append(asyncio.create_task(_keep(bridges, "bridges")))
        failed = asyncio.create_task(supervisor.keep_running())
        asked = asyncio.create_task(stop.requested.wait())
        watching += [failed, asked]
        if start:
            # Ctrl-C and a service that ends at once count during the start, too.
            starting = asyncio.create_task(_start(bus_config))
            watching.append(starting)
            await asyncio.wait((failed, asked, starting), return_when=asyncio.FIRST_COMPLETED)
            if starting.done():
                starting.result()
        await asyncio.wait((failed, asked), return_when=asyncio.FIRST_COMPLETED)
        if not asked.done():
            raise supervisor.failure(failed.result())
    finally:
        for task in watching:
            task.cancel()
        await asyncio.gather(*watching, return_exceptions=True)
        await asyncio.gather(*(each.stop() for each in (supervisor, beside, bridges, *cameras)))
    return stop.exit_code


def cameras_here(rig: RigConfig, bus: BusConfig) -> list[str]:
    """Return the cameras whose capture services belong on this machine.

    Cameras elsewhere need a router that they reach: where it opens only this machine's own addresses, all are here.
    """
    if not all(map(is_local, (*bus.connect, *bus.listen))):
        return []
    has_libcamera = importlib.util.find_spec("picamera2") is not None
    kinds = {"v4l2", "webcam", "images", "video", *(("picamera2",) if has_libcamera else ())}
    return [name for name, camera in rig.cameras.items() if camera.source in kinds]


async def _keep(supervisor: Supervisor, what: str) -> None:
    logger.error("%s; all else goes on without %s", supervisor.failure(await supervisor.keep_running()), what)


async def _start(bus_config: BusConfig) -> None:
    async with await Bus.open(bus_config, timeout_s=_RIG_TIMEOUT_S) as bus:
        control = await broadcast(bus, "start", new_session(), 0.5, _RIG_TIMEOUT_S)
        logger.info("session %s started; look with `rhot status`, end with Ctrl-C", control.session)


async def _alive(bus_config: BusConfig) -> set[str] | None:
    """Return the services that live on the bus, as `service/instance`; None when no router answers."""
    try:
        router_try_s = 0.3
        async with await Bus.open(bus_config, timeout_s=router_try_s) as bus:
            return {reply.key.removeprefix("rhot/alive/") for reply in await bus.who_is_alive()}
    except BusError:
        return None


def _refuse_second_rig(alive: set[str], bus_config: BusConfig) -> None:
    """Refuse to run beside another rig: two would publish on the same keys, and readers would see both hands mixed.

    Objects and feet may run on another machine, where their devices are.
    """
    found = sorted(alive & {"fusion/main", "ik/main"})
    if found:
        raise BusError(
            f"a rig runs at {', '.join(bus_config.connect)} already ({', '.join(found)}); end it first (Ctrl-C in its "
            "terminal, or sudo systemctl stop rhot.target), or give this one a `namespace` under [bus] in rig.toml"
        )
