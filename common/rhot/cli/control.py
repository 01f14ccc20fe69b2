"""`rhot start` and `rhot stop`: the broadcast that all services follow."""

from __future__ import annotations

import asyncio
import contextlib
import time
from pathlib import Path
from typing import Literal

import click

from rhot.bus import Bus
from rhot.cli.options import bus_options, rig_option, tool_bus
from rhot.clock import Exchange, SystemClock
from rhot.errors import BusError, WireError
from rhot.messages import Control, decode
from rhot.rig import BusConfig
from rhot.service.clock_sync import exchange_once
from rhot.service.runner import CONTROL_KEY

_CLOCK_TRIES = 5


async def rig_now_ns(bus: Bus, wait_s: float) -> int:
    """Return rig time by asking its owner, the quickest of a few exchanges.

    Raises:
        BusError: nobody answers within `wait_s`.
    """
    clock = SystemClock()
    deadline = time.monotonic() + wait_s
    exchanges: list[Exchange] = []
    while len(exchanges) < _CLOCK_TRIES:
        answered = await exchange_once(bus, clock, timeout_s=0.5)
        if answered is not None:
            exchanges.append(answered[0])
        elif time.monotonic() >= deadline:
            raise BusError(
                "no service answers rhot/clock, so there is no rig time to start at; start fusion first "
                "(`rhot up`, `rhot fusion`, or systemctl start rhot.target), or wait for it with --wait SECONDS"
            )
        else:
            await asyncio.sleep(0.1)
    best = min(exchanges, key=lambda exchange: exchange.round_trip_ns)
    return clock.now_ns() + best.offset_ns


async def broadcast(bus: Bus, action: Literal["start", "stop"], session: str, delay_s: float, wait_s: float) -> Control:
    """Publish a control message and return it once a service holds it."""
    now_ns = await rig_now_ns(bus, wait_s)
    publisher = bus.publisher(CONTROL_KEY, Control, reliable=True)
    await publisher.wait_for_reader(2.0)
    start_ns = now_ns + round(delay_s * 1e9) if action == "start" else 0
    return publisher.put(Control(t_ns=now_ns, action=action, session=session, start_t_ns=start_ns))


async def newest_control(bus: Bus) -> Control | None:
    """Return the newest control message that any service knows; None when the rig was never started."""
    newest: Control | None = None
    for reply in await bus.get(CONTROL_KEY, timeout_s=1.0):
        with contextlib.suppress(WireError):
            control = decode(reply.payload, Control)
            if newest is None or control.t_ns > newest.t_ns:
                newest = control
    return newest


async def _control(
    config: BusConfig, action: Literal["start", "stop"], session: str, delay_s: float, wait_s: float
) -> None:
    async with await Bus.open(config, timeout_s=max(wait_s, 2.0)) as bus:
        sent = await broadcast(bus, action, session, delay_s, wait_s)
        alive = sorted({reply.key.removeprefix("rhot/alive/") for reply in await bus.who_is_alive()})
        click.echo(
            f"{action} {sent.session or '(any session)'} sent to {len(alive)} services: {', '.join(alive) or 'none'}"
        )


def new_session() -> str:
    """Return a name for a session that begins now."""
    return time.strftime("%Y%m%d-%H%M%S")


@click.command()
@click.option("--session", help="Name of the session; the date and time when not given.")
@click.option(
    "--delay",
    "delay_s",
    type=click.FloatRange(0, 30),
    default=0.5,
    show_default=True,
    help="Start this many seconds from now, so that all cameras begin together.",
)
@click.option(
    "--wait",
    "wait_s",
    type=click.FloatRange(0, 3600),
    default=2.0,
    show_default=True,
    help="Wait this many seconds for the rig to come up.",
)
@rig_option
@bus_options
def start(
    session: str | None, delay_s: float, wait_s: float, rig_path: Path, connect: tuple[str, ...], namespace: str | None
) -> None:
    """Tell every service of the rig to start at one moment; those that join later follow by themselves."""
    config = tool_bus(rig_path, connect, namespace)
    asyncio.run(_control(config, "start", session or new_session(), delay_s, wait_s))


@click.command()
@click.option("--session", default="", help="Stop only this session.")
@rig_option
@bus_options
def stop(session: str, rig_path: Path, connect: tuple[str, ...], namespace: str | None) -> None:
    """Tell every service of the rig to stop and wait for the next start."""
    asyncio.run(_control(tool_bus(rig_path, connect, namespace), "stop", session, 0.0, 2.0))
