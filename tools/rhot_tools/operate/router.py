"""`rhot router`: a Zenoh router inside Python, so that nothing else needs installing."""

from __future__ import annotations

import asyncio
import contextlib
import logging
from pathlib import Path

import click

from rhot.bus import Bus
from rhot.cli.options import endpoints, namespace_option, overridden, rig_option
from rhot.rig import BusConfig
from rhot.rig.folder import RIG_FILE, load_config
from rhot.service import systemd
from rhot.service.stop import install_stop

logger = logging.getLogger(__name__)

DEFAULT_LISTEN = ("tcp/127.0.0.1:7447",)


async def _route(config: BusConfig) -> int:
    stopping = install_stop()
    async with await Bus.open(config):
        who = "for who holds a certificate" if config.tls else "for everybody who reaches it"
        logger.info("routing on %s, %s", ", ".join(config.listen), who)
        systemd.notify("READY=1")
        interval_s = systemd.watchdog_interval_s()
        while not stopping.requested.is_set():
            with contextlib.suppress(TimeoutError):
                await asyncio.wait_for(stopping.requested.wait(), interval_s)
            systemd.notify("WATCHDOG=1")
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
