"""`rhot start`, `stop`, `status` and `router`: running a rig from the command line."""

from __future__ import annotations

import asyncio
import contextlib
import json
import logging
from pathlib import Path
from typing import Literal

import click
from rich.console import Console

from rhot.bus import CONNECT_S, Bus
from rhot.cli.options import FiniteRange, bus_options, endpoints, namespace_option, overridden, rig_option, tool_bus
from rhot.errors import BusError
from rhot.messages import ServiceStatus
from rhot.operation.control import broadcast, followers, new_session, newest_control, rig_now_ns
from rhot.operation.status import fetch_status, status_table
from rhot.rig import BusConfig
from rhot.rig.folder import RIG_FILE, load_config
from rhot.service.stop import install_stop, notify, watchdog_interval_s

# `rhot router`: a Zenoh router inside Python, so that nothing else needs installing.

logger = logging.getLogger(__name__)

DEFAULT_LISTEN = ("tcp/127.0.0.1:7447",)


async def _route(config: BusConfig) -> int:
    stopping = install_stop()
    async with await Bus.open(config):
        who = "for who holds a certificate" if config.tls else "for everybody who reaches it"
        logger.info("routing on %s, %s", ", ".join(config.listen), who)
        notify("READY=1")
        interval_s = watchdog_interval_s()
        while not stopping.requested.is_set():
            with contextlib.suppress(TimeoutError):
                await asyncio.wait_for(stopping.requested.wait(), interval_s)
            notify("WATCHDOG=1")
    return stopping.exit_code


@click.command()
@click.option(
    "--listen",
    multiple=True,
    metavar="ENDPOINT",
    help="Endpoint to open. Without it, rig.toml decides, or else tcp/127.0.0.1:7447. May be repeated.",
)
@namespace_option
@rig_option
def router(listen: tuple[str, ...], rig_path: Path, namespace: str | None) -> int:
    """Connect all services of a rig, until Ctrl-C. Any Zenoh router of the same version works too.

    One router serves several namespaces. With certificates, clients can only access the namespace of the rig.
    """
    bus = load_config(rig_path).bus if (rig_path / RIG_FILE).exists() else BusConfig()
    bus = overridden(bus, (), namespace)
    chosen = endpoints("--listen", listen) or bus.listen or DEFAULT_LISTEN
    return asyncio.run(_route(bus.model_copy(update={"mode": "router", "connect": (), "listen": chosen})))


# `rhot status`: which services are alive and how they do.


async def _fetch(config: BusConfig) -> tuple[set[str], dict[str, ServiceStatus]]:
    async with await Bus.open(config, timeout_s=CONNECT_S) as bus:
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


# `rhot start` and `rhot stop`: the broadcast that all services follow.

_AUTO_WAIT_S = 3600.0
_LOOKS = 3
_LOOK_S = 1.0
"""Services ask for the start signal every two seconds: one that joined before has told the others by then."""


async def _control(
    config: BusConfig, action: Literal["start", "stop"], session: str, delay_s: float, wait_s: float
) -> None:
    async with await Bus.open(config, timeout_s=max(wait_s, CONNECT_S)) as bus:
        if action == "stop" and session:
            known = await newest_control(bus)
            if known is not None and known.session != session:
                runs = f"session {known.session} runs" if known.action == "start" else "the rig is stopped"
                raise BusError(f"--session {session}: {runs}; nothing was changed")
        sent = await broadcast(bus, action, session, delay_s, wait_s)
        alive = sorted({reply.key.removeprefix("rhot/alive/") for reply in await bus.who_is_alive()})
        # A camera's certificate does not even show who is there.
        # A service takes a start or stop as it arrives; on a busy machine it may answer late.
        if (alive or config.tls) and not await followers(bus, sent, 3.0):
            raise BusError(
                f"{action} was sent, but no service took it; on a secured bus only an operator may start and stop "
                "(`rhot keys list` names the roles, RHOT_IDENTITY chooses a certificate)"
            )
        services = "1 service" if len(alive) == 1 else f"{len(alive)} services"
        click.echo(f"{action} {sent.session or '(any session)'} sent to {services}: {', '.join(alive) or 'none'}")


async def _start_by_itself(config: BusConfig, delay_s: float, wait_s: float) -> None:
    """Start a session unless somebody has started or stopped the rig: whoever has stayed awake knows that."""
    async with await Bus.open(config, timeout_s=wait_s) as bus:
        await rig_now_ns(bus, wait_s)
        for _ in range(_LOOKS):
            known = await newest_control(bus)
            if known is not None:
                click.echo(f"left as it is: {known.action} {known.session or '(any session)'}")
                return
            await asyncio.sleep(_LOOK_S)
        sent = await broadcast(bus, "start", new_session(), delay_s, wait_s)
        click.echo(f"start {sent.session} sent")


@click.command()
@click.option("--session", help="Name of the session.  [default: date and time]")
@click.option(
    "--delay",
    "delay_s",
    type=FiniteRange(0, 30),
    default=0.5,
    show_default=True,
    help="Start this many seconds from now, so that all cameras start together.",
)
@click.option(
    "--wait",
    "wait_s",
    type=FiniteRange(0, 3600),
    default=2.0,
    show_default=True,
    help="Wait this many seconds for the rig to come up.",
)
@click.option(
    "--auto",
    is_flag=True,
    help="Start only where rig.toml says autostart = true and nobody has started or stopped the rig; wait for it an "
    "hour. The installed services do this after a power cut.",
)
@rig_option
@bus_options
def start(
    session: str | None,
    delay_s: float,
    wait_s: float,
    auto: bool,
    rig_path: Path,
    connect: tuple[str, ...],
    namespace: str | None,
) -> None:
    """Tell every service of the rig to start at the same time. Services that join later start automatically."""
    config = tool_bus(rig_path, connect, namespace)
    if auto:
        if load_config(rig_path).autostart:
            asyncio.run(_start_by_itself(config, delay_s, max(wait_s, _AUTO_WAIT_S)))
        else:
            click.echo(f"{rig_path / RIG_FILE} does not say autostart = true: nothing is started")
        return
    asyncio.run(_control(config, "start", session or new_session(), delay_s, wait_s))


@click.command()
@click.option("--session", default="", help="Stop only this session.")
@rig_option
@bus_options
def stop(session: str, rig_path: Path, connect: tuple[str, ...], namespace: str | None) -> None:
    """Tell every service of the rig to stop and wait for the next start."""
    # Without waiting for the rig clock: a stop is obeyed whatever its time says.
    asyncio.run(_control(tool_bus(rig_path, connect, namespace), "stop", session, delay_s=0.0, wait_s=0.0))
