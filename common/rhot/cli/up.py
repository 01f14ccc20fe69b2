"""`rhot up`: everything of the PC side in one terminal."""

from __future__ import annotations

import asyncio
import logging
import time
from pathlib import Path

import click

from rhot.bus import Bus
from rhot.cli.control import broadcast
from rhot.cli.options import rig_option, tool_bus
from rhot.errors import BusError
from rhot.rig import load_rig
from rhot.service.stop import install_stop
from rhot.supervisor import Supervisor

logger = logging.getLogger(__name__)

_ROUTER_TRY_S = 0.3
_RIG_TIMEOUT_S = 20.0


@click.command()
@click.option("--no-start", is_flag=True, help="Do not broadcast `start`; wait for `rhot start`.")
@rig_option
def up(no_start: bool, rig_path: Path) -> int:
    """Run router, fusion, ik and objects on this machine and start the rig; Ctrl-C ends all of them.

    The capture services run on the Pis (rhot capture --camera NAME) and join by themselves. A router that already
    answers is used instead of a second one.
    """
    return asyncio.run(_up(rig_path, start=not no_start))


async def _up(rig_path: Path, *, start: bool) -> int:
    rig = load_rig(rig_path)
    bus_config = tool_bus(rig_path, (), None)
    stop = install_stop()
    supervisor = Supervisor()
    try:
        if not await _answers(rig_path):
            await supervisor.start("router", ["router", "--rig", str(rig_path)])
        for name in ("fusion", "ik", *(["objects"] if rig.config.objects else [])):
            await supervisor.start(name, [name, "--rig", str(rig_path)])
        if start:
            async with await Bus.open(bus_config, timeout_s=_RIG_TIMEOUT_S) as bus:
                session = time.strftime("%Y%m%d-%H%M%S")
                await broadcast(bus, "start", session, 0.5, _RIG_TIMEOUT_S)
                logger.info("session %s started; look with `rhot status`, end with Ctrl-C", session)
        failed = asyncio.create_task(supervisor.wait_for_failure())
        asked = asyncio.create_task(stop.requested.wait())
        await asyncio.wait((failed, asked), return_when=asyncio.FIRST_COMPLETED)
        asked.cancel()
        if not stop.requested.is_set():
            raise supervisor.failure(failed.result())
        failed.cancel()
    finally:
        await supervisor.stop()
    return stop.exit_code


async def _answers(rig_path: Path) -> bool:
    try:
        async with await Bus.open(tool_bus(rig_path, (), None), timeout_s=_ROUTER_TRY_S):
            return True
    except BusError:
        return False
