"""`rhot config`: show or change what a running service is configured to do."""

from __future__ import annotations

import asyncio
import json
from pathlib import Path
from typing import Any

import click

from rhot.bus import CONNECT_S, Bus
from rhot.cli.options import bus_options, rig_option, tool_bus
from rhot.errors import BusError, ConfigError
from rhot.rig import BusConfig
from rhot.service.configuration import parse_change
from rhot_tools.operate.inspect import json_text, plain_value


async def _config(bus_config: BusConfig, service: str, change: dict[str, Any]) -> Any:
    key = f"rhot/config/{service}"
    async with await Bus.open(bus_config, timeout_s=CONNECT_S) as bus:
        if change:
            # Asked with the change as payload, the service answers with its new configuration or with its refusal.
            replies = await bus.get(f"{key}?format=json", json.dumps(change).encode())
        else:
            replies = await bus.get(f"{key}?format=json")
        if not replies and not change and bus_config.tls:
            # Whoever may only read may not name the key: with wildcards a question changes nothing.
            replies = [reply for reply in await bus.get("rhot/config/**?format=json") if reply.key == key]
        if not replies and f"rhot/alive/{service}" in {reply.key for reply in await bus.who_is_alive()}:
            raise BusError(
                f"{service}: is alive and does not answer; on a secured bus only an operator may change configurations "
                "(`rhot keys list` names the roles, RHOT_IDENTITY chooses a certificate)"
            )
    if not replies:
        raise BusError(f"{service}: no such service is running; `rhot status` shows who is there")
    if replies[0].error:
        raise ConfigError(f"{service}: {replies[0].error}")
    return plain_value(replies[0].payload, replies[0].encoding)


def parse_assignments(words: tuple[str, ...]) -> dict[str, Any]:
    """Return the change that words like `thumb.threshold=0.4` ask for; values are JSON, or else plain text.

    Raises:
        ConfigError: a word has no `=`, or names a field inside of what another word gives a value.
    """
    change: dict[str, Any] = {}
    for word in words:
        path, equals, text = word.partition("=")
        if not equals or not path:
            raise ConfigError(f"'{word}' is not FIELD=VALUE")
        try:
            value: Any = json.loads(text)
        except ValueError:
            value = text
        target = change
        *parents, last = path.split(".")
        for parent in parents:
            target = target.setdefault(parent, {})
            if not isinstance(target, dict):
                raise ConfigError(f"'{word}': {parent} has a value of its own already; give one or the other")
        target[last] = value
    return parse_change(json.dumps(change).encode())


@click.command()
@click.argument("service", metavar="SERVICE/INSTANCE")
@click.argument("changes", nargs=-1, metavar="[FIELD=VALUE]...")
@rig_option
@bus_options
def config(
    service: str, changes: tuple[str, ...], rig_path: Path, connect: tuple[str, ...], namespace: str | None
) -> None:
    """Show the configuration of a running service, or change fields of it.

    \b
    rhot config fusion/main
    rhot config fusion/main method=disparity
    rhot config capture/left exposure_s=0.003 gain=6

    The change lasts until the service restarts; rig.toml is not written.
    """
    if "*" in service:
        raise ConfigError(f"{service}: one service at a time, such as capture/left; `rhot status` names them")
    value = asyncio.run(_config(tool_bus(rig_path, connect, namespace), service, parse_assignments(changes)))
    click.echo(json_text(value, indent=1))
