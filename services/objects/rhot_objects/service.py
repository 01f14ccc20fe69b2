"""The objects service: reads every source at its rate and publishes poses in the rig frame."""

from __future__ import annotations

import asyncio
import logging
from typing import Final

from pydantic import BaseModel

from rhot.errors import ConfigError, DeviceError
from rhot.messages import Control
from rhot.rig import Rig
from rhot.rig.config import ObjectConfig
from rhot.rig.file_model import FileModel
from rhot.rig.folder import latest_rig
from rhot.service import Node
from rhot_objects.assemble import SourcePlan, plan_sources

logger = logging.getLogger(__name__)

_RETRY_S: Final = 2.0


class ObjectsConfig(FileModel):
    """What `rhot/config/objects/<instance>` shows."""

    objects: dict[str, ObjectConfig]


class ObjectsService:
    """Publishes `rhot/object/<id>` and `rhot/head`; see `rhot.service.Service` for the seam."""

    name = "objects"
    instance = "main"
    owns_clock = False

    def __init__(self, rig: Rig) -> None:
        """Prepare for the objects of a rig.

        Raises:
            ConfigError: the rig has no objects, or two share a tracker.
        """
        if not rig.config.objects:
            raise ConfigError(f"{rig.path / 'rig.toml'} names no objects; add [objects.NAME] with source and serial")
        plan_sources(rig)
        self._rig = rig
        self._plans: list[SourcePlan] = []
        self._config = ObjectsConfig(objects=rig.config.objects)

    @property
    def config(self) -> ObjectsConfig:
        """The objects of the rig."""
        return self._config

    def reconfigure(self, config: BaseModel) -> None:
        """Refuse: which tracker is which object is set in `rig.toml`."""
        raise ConfigError("objects are named in rig.toml; change it there and restart this service")

    def attach(self, node: Node) -> None:
        """Show what is left out; an object's key appears with its first pose."""
        node.status.include(self._counts)

    def _counts(self) -> dict[str, int]:
        return {"unusable": sum(plan.stage.unusable for plan in self._plans)}

    async def run(self, node: Node, start: Control) -> None:
        """Read all sources until cancelled; one that is absent does not hold up the others."""
        async with asyncio.TaskGroup() as tasks:
            self._plans = plan_sources(latest_rig(self._rig))
            for plan in self._plans:
                tasks.create_task(self._follow(node, start, plan))

    async def _follow(self, node: Node, start: Control, plan: SourcePlan) -> None:
        logged = ""
        while True:
            try:
                await asyncio.to_thread(plan.source.open, start.start_t_ns)
                logged = ""
                await self._poll(node, plan)
            except DeviceError as error:
                node.status.count("device_errors")
                node.status.error(str(error))
                if str(error) != logged:
                    logger.warning("%s: %s; looking again every %.0f s", plan.name, error, _RETRY_S)
                    logged = str(error)
            finally:
                plan.source.close()
            await asyncio.sleep(_RETRY_S)

    async def _poll(self, node: Node, plan: SourcePlan) -> None:
        loop = asyncio.get_running_loop()
        period_s = 1.0 / plan.rate_hz
        due = loop.time()
        while True:
            samples = await asyncio.to_thread(plan.source.read, node.clock.now_ns())
            node.status.tick("reads")
            for key, message in plan.stage.feed(samples, node.clock.now_ns()):
                node.publish(key, message)
            # Too slow for the rate: what is past is skipped instead of run after.
            due = max(due + period_s, loop.time())
            await asyncio.sleep(due - loop.time())
