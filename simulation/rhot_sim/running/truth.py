"""`rhot truth`: the service that publishes what is true in the simulated world."""

from __future__ import annotations

import asyncio
from pathlib import Path
from typing import Final

import click
from pydantic import BaseModel

from rhot.cli.options import bus_options, rig_option, tool_bus
from rhot.errors import ConfigError
from rhot.messages import Control
from rhot.operation.priority import lower_priority
from rhot.rig import Rig, load_rig
from rhot.rig.config import SimConfig
from rhot.rig.folder import latest_rig
from rhot.service import Node, run_service
from rhot_sim.world.world import World

TRUTH_KEY: Final = "rhot/truth"
_RATE_HZ: Final = 60.0
_UNREAD_S: Final = 0.1
"""How often truth is made while nobody subscribes, for those who ask: making it 60 times a second costs 7 % of a core,
which the tracker beside it can use."""


class TruthService:
    """Publishes `rhot/truth`; see `rhot.service.Service` for the seam."""

    name = "truth"
    instance = "main"
    owns_clock = False

    def __init__(self, rig: Rig) -> None:
        """Prepare for the world that a rig describes; each session takes it as the rig folder holds it then."""
        self._config = rig.config.sim
        self._rig = rig

    @property
    def config(self) -> SimConfig:
        """The world's configuration."""
        return self._config

    def reconfigure(self, config: BaseModel) -> None:
        """Refuse: every process computes the same world from `rig.toml`."""
        raise ConfigError("the simulated world is set in rig.toml, the same for all processes; change it there")

    def attach(self, node: Node) -> None:
        """Nothing to declare before the first truth."""

    async def run(self, node: Node, start: Control) -> None:
        """Publish the world's truth until cancelled: at a steady rate while somebody subscribes."""
        period_ns = round(1e9 / _RATE_HZ)
        self._rig = latest_rig(self._rig)
        self._config = self._rig.config.sim
        world = World.from_rig(self._rig)
        while True:
            now_ns = node.clock.now_ns()
            elapsed_ns = now_ns - start.start_t_ns
            t_ns = now_ns - elapsed_ns % period_ns
            node.publish(TRUTH_KEY, world.truth((t_ns - start.start_t_ns) / 1e9, t_ns))
            to_next_s = (period_ns - elapsed_ns % period_ns) / 1e9
            await asyncio.sleep(to_next_s if node.has_reader(TRUTH_KEY) else _UNREAD_S)


@click.command()
@rig_option
@bus_options
def truth(rig_path: Path, connect: tuple[str, ...], namespace: str | None) -> int:
    """Publish rhot/truth, the ground truth of the simulated world, until Ctrl-C."""
    # It must not disturb what it is there to judge.
    lower_priority(5)
    return run_service(TruthService(load_rig(rig_path)), tool_bus(rig_path, connect, namespace))
