"""`rhot get` and `rhot watch`: look at any key of a running rig."""

from __future__ import annotations

import asyncio
import json
import sys
import time
from pathlib import Path
from typing import Any

import click

from rhot.bus import CONNECT_S, Bus, Reply
from rhot.cli.options import FiniteRange, bus_options, rig_option, tool_bus
from rhot.errors import BusError, ConfigError, WireError
from rhot.messages import unpack
from rhot.rig import BusConfig
from rhot.text import printable

_MOST_KEYS = 200
"""Keys whose rates are shown one by one."""


def plain_value(payload: bytes, encoding: str) -> Any:
    """Return a payload as something that JSON can show; bytes that are neither JSON nor msgpack by their size."""
    try:
        if encoding.startswith(("application/json", "text/json")):
            return json.loads(payload)
        if encoding.startswith("application/msgpack"):
            return unpack(payload)
        if encoding.startswith("text/"):
            return payload.decode()
    except (ValueError, RecursionError, WireError) as error:
        return {"invalid": str(error), "bytes": len(payload)}
    return {"encoding": encoding, "bytes": len(payload)}


def json_text(value: Any, *, indent: int | None = None, ensure_ascii: bool = True) -> str:
    """Return a value of `plain_value` as JSON; where JSON cannot hold it, why not."""
    try:
        return json.dumps(value, ensure_ascii=ensure_ascii, default=repr, indent=indent)
    except (TypeError, RecursionError) as error:
        # msgpack may hold keys that are bytes, and nest deeper than Python can follow.
        return json.dumps({"invalid": str(error)})


def _line(key: str, value: Any) -> str:
    line = f'{{"key": {json.dumps(key, ensure_ascii=False)}, "value": {json_text(value, ensure_ascii=False)}}}'
    return printable(line, len(line))


def _selector(key_expr: str) -> str:
    return key_expr if "?" in key_expr else f"{key_expr}?format=json"


def _nobody(key_expr: str) -> str:
    return f"{key_expr}: no service answers this key; `rhot status` shows who is there"


async def _get(bus_config: BusConfig, selector: str, timeout_s: float) -> list[Reply]:
    async with await Bus.open(bus_config, timeout_s=CONNECT_S) as bus:
        return await bus.get(selector, timeout_s=timeout_s)


@click.command()
@click.argument("key_expr", metavar="KEYEXPR")
@click.option("--raw", is_flag=True, help="Write the bytes of the first answer as they are, such as a preview picture.")
@click.option(
    "--timeout",
    "timeout_s",
    type=FiniteRange(0.05, 60),
    default=2.0,
    show_default=True,
    help="Seconds to wait for answers.",
)
@rig_option
@bus_options
def get(
    key_expr: str, raw: bool, timeout_s: float, rig_path: Path, connect: tuple[str, ...], namespace: str | None
) -> None:
    """Print the last value of every key that matches KEYEXPR, one JSON object per line.

    \b
    rhot get 'rhot/**'                       everything there is
    rhot get 'rhot/hand/*'                   both hands
    rhot get 'rhot/status/**'                how every service does
    rhot get --raw 'rhot/preview/left?overlay=markers' > left.jpg
    """
    selector = key_expr if raw else _selector(key_expr)
    replies = asyncio.run(_get(tool_bus(rig_path, connect, namespace), selector, timeout_s))
    errors = [reply.error for reply in replies if reply.error]
    values = sorted((reply for reply in replies if not reply.error), key=lambda reply: reply.key)
    if raw:
        if not values:
            raise BusError("; ".join(errors) or _nobody(key_expr))
        if sys.stdout.isatty():
            raise ConfigError("--raw writes bytes, which a terminal would obey; send them to a file with > FILE")
        sys.stdout.buffer.write(values[0].payload)
        return
    shown: set[str] = set()
    for reply in values:
        line = _line(reply.key, plain_value(reply.payload, reply.encoding))
        # Several services know the control message; one line is enough where they agree.
        if line not in shown:
            click.echo(line)
            shown.add(line)
    if not values:
        raise BusError("; ".join(errors) or _nobody(key_expr))
    for error in errors:
        click.echo(f"rhot: {key_expr}: {error}", err=True)


async def _watch(bus_config: BusConfig, key_expr: str, count: int | None, duration_s: float | None) -> None:
    async with await Bus.open(bus_config, timeout_s=CONNECT_S) as bus:
        try:
            async with asyncio.timeout(duration_s):
                left = count
                async for sample in bus.events(key_expr):
                    value = None if sample.deleted else plain_value(sample.payload, sample.encoding)
                    click.echo(_line(sample.key, value))
                    if left is not None:
                        left -= 1
                        if left <= 0:
                            return
        except TimeoutError:
            return


@click.command()
@click.argument("key_expr", metavar="KEYEXPR")
@click.option("--count", type=click.IntRange(min=1), help="Stop after this many messages.")
@click.option("--duration", "duration_s", type=FiniteRange(min=0.01), help="Stop after this many seconds.")
@click.option("--rate", is_flag=True, help="Show the rate of each key once a second instead of the messages.")
@rig_option
@bus_options
def watch(
    key_expr: str,
    count: int | None,
    duration_s: float | None,
    rate: bool,
    rig_path: Path,
    connect: tuple[str, ...],
    namespace: str | None,
) -> None:
    """Print messages on KEYEXPR as they arrive, one JSON object per line, until Ctrl-C.

    \b
    rhot watch 'rhot/hand/right' --count 1
    rhot watch 'rhot/**' --rate
    """
    config = tool_bus(rig_path, connect, namespace)
    asyncio.run(_rates(config, key_expr, duration_s) if rate else _watch(config, key_expr, count, duration_s))


async def _rates(bus_config: BusConfig, key_expr: str, duration_s: float | None) -> None:
    async with await Bus.open(bus_config, timeout_s=CONNECT_S) as bus:
        counts: dict[str, int] = {}
        mailbox = bus.events(key_expr)

        async def tally() -> None:
            async for sample in mailbox:
                key = sample.key if sample.key in counts or len(counts) < _MOST_KEYS else "(other keys)"
                counts[key] = counts.get(key, 0) + 1

        async def show() -> None:
            before, before_at = dict(counts), time.monotonic()
            while True:
                await asyncio.sleep(1.0)
                elapsed = time.monotonic() - before_at
                rates = {key: (number - before.get(key, 0)) / elapsed for key, number in sorted(counts.items())}
                click.echo("   ".join(f"{key} {value:.1f}/s" for key, value in rates.items()) or "nothing yet")
                before, before_at = dict(counts), time.monotonic()

        try:
            async with asyncio.timeout(duration_s), asyncio.TaskGroup() as tasks:
                tasks.create_task(tally())
                tasks.create_task(show())
        except TimeoutError:
            return
