"""`rhot mark`: says that something happened now, for recordings and whoever listens."""

from __future__ import annotations

import asyncio
import os
import sys
import threading
import time
from functools import partial
from pathlib import Path

import click
from pydantic import ValidationError

from rhot.bus import CONNECT_S, Bus
from rhot.cli.options import bus_options, rig_option, tool_bus
from rhot.clock import difference_ns
from rhot.errors import ConfigError
from rhot.messages import Event, first_problem
from rhot.operation.control import EventPublisher
from rhot.rig import BusConfig
from rhot_tools.recordings.triggers import GpioPin, LslMarkers, Triggers

_UNKNOWN_S = 0.5
"""Between Enter and the first line of a program, where the system does not say when it began."""


def _begun_ns() -> int:
    """Return when this process began, system time."""
    if sys.platform != "linux":
        return time.time_ns() - round(1e9 * _UNKNOWN_S)
    else:  # noqa: RET505  # for mypy, which reads what follows a platform's return as dead
        ticks = int(Path("/proc/self/stat").read_text().rpartition(")")[2].split()[19])
        since_boot_ns = ticks * 10**9 // os.sysconf("SC_CLK_TCK")
        return since_boot_ns + difference_ns(time.time_ns, partial(time.clock_gettime_ns, time.CLOCK_BOOTTIME))


@click.command()
@click.argument("label", required=False)
@click.option(
    "--lsl", "lsl_name", metavar="NAME", help="Follow the LSL marker stream NAME, or all with --lsl all, until Ctrl-C."
)
@click.option(
    "--gpio",
    "pin",
    type=click.IntRange(0, 63),
    metavar="PIN",
    help="Follow GPIO PIN of this Raspberry Pi until Ctrl-C.",
)
@rig_option
@bus_options
def mark(
    label: str | None,
    lsl_name: str | None,
    pin: int | None,
    rig_path: Path,
    connect: tuple[str, ...],
    namespace: str | None,
) -> None:
    """Mark this moment with LABEL, such as the start of a trial.

    Recordings keep it, `rhot export` writes it into C3D, BIDS, NWB and other files, and every program may listen to
    rhot/event. A label alone is stamped with the moment at which this command began, to 0.01 s (0.5 s on Windows and
    macOS, which do not say when that was). Without one, each line that you type, or pipe in, marks the moment at which
    it arrives, to the uncertainty of the clocks; an empty line repeats the last label, Ctrl-D ends it.

    \b
    rhot mark grasp
    rhot mark            then type: rest, Enter, grasp, Enter, …
    rhot mark --lsl all  triggers of PsychoPy and others that send LSL markers
    rhot mark --gpio 17  rising edges, stamped by the kernel; LABEL names them
    """
    if label is not None and not label.strip():
        raise ConfigError('LABEL is empty: say what happened, such as "trial 3"')
    if lsl_name is not None and (label is not None or pin is not None):
        raise ConfigError("--lsl goes with neither LABEL nor --gpio: the labels of a marker stream are its own")
    bus = tool_bus(rig_path, connect, namespace)
    if lsl_name is not None:
        asyncio.run(_follow(bus, LslMarkers(lsl_name)))
    elif pin is not None:
        asyncio.run(_follow(bus, GpioPin(pin, label or f"gpio {pin}")))
    else:
        asyncio.run(_mark(bus, label, _begun_ns()))


async def _mark(config: BusConfig, label: str | None, begun_ns: int) -> None:
    async with await Bus.open(config, timeout_s=CONNECT_S) as bus:
        events = EventPublisher(bus)
        if label is not None:
            # The system counts a process's start in hundredths of a second.
            await _publish(events, label, begun_ns, 0.01 if sys.platform == "linux" else _UNKNOWN_S)
            return
        last = "mark"
        while line := await asyncio.to_thread(sys.stdin.readline):
            last = line.strip() or last
            await _publish(events, last, time.time_ns(), 0.0)


async def _follow(config: BusConfig, triggers: Triggers) -> None:
    came: asyncio.Queue[tuple[str, int] | None] = asyncio.Queue()
    loop, ended = asyncio.get_running_loop(), threading.Event()

    def tell(label: str, at_ns: int) -> None:
        loop.call_soon_threadsafe(came.put_nowait, (label, at_ns))

    async with await Bus.open(config, timeout_s=CONNECT_S) as bus:
        events = EventPublisher(bus)
        click.echo(f"waiting for {triggers.where}; Ctrl-C ends it", err=True)
        following = asyncio.create_task(asyncio.to_thread(triggers.follow, tell, ended))
        following.add_done_callback(lambda _: came.put_nowait(None))
        try:
            while (trigger := await came.get()) is not None:
                await _publish(events, *trigger, triggers.uncertainty_s, triggers.source)
            await following
        finally:
            ended.set()


async def _publish(events: EventPublisher, label: str, at_ns: int, late_s: float, source: str = "mark") -> Event:
    try:
        event = await events.put(label, source, at_ns=at_ns, late_s=late_s)
    except ValidationError as error:
        raise ConfigError(first_problem(error)) from error
    click.echo(f"{event.label}  {event.t_ns}  ± {1e3 * (event.uncertainty_s or 0.0):.1f} ms")
    return event
