"""The objects service: reads every source at its rate and publishes poses in the rig frame."""

from __future__ import annotations

import asyncio
import dataclasses
import logging
from collections.abc import Mapping
from functools import partial
from typing import Final

from pydantic import BaseModel

from rhot.errors import ConfigError, DeviceError
from rhot.messages import Control
from rhot.rig import RegistrationFile, Rig
from rhot.rig.config import ObjectConfig
from rhot.rig.file_model import FileModel
from rhot.rig.folder import latest_rig
from rhot.service import Node
from rhot.service.device_thread import CLOSE_LIMIT_S, OPEN_LIMIT_S, DeviceThread
from rhot_objects.assemble import SourcePlan, plan_sources, source_kind
from rhot_objects.pose import Registration
from rhot_objects.sources import SpaceMovedError

logger = logging.getLogger(__name__)

_RETRY_S: Final = 2.0
_READ_LIMIT_S: Final = 5.0
"""Limit of one read; a tracking system normally answers within a millisecond."""


class ObjectsConfig(FileModel):
    """What `rhot/config/objects/<instance>` shows."""

    objects: dict[str, ObjectConfig]


class ObjectsService:
    """Publishes `rhot/object/<id>` and `rhot/head`; implements `rhot.service.Service`."""

    name = "objects"
    instance = "main"
    owns_clock = False

    def __init__(self, rig: Rig) -> None:
        """Validate the objects of a rig.

        Raises:
            ConfigError: the rig has no objects, or two share a tracker.
        """
        if not rig.config.objects:
            raise ConfigError(f"{rig.path / 'rig.toml'} names no objects; add [objects.NAME] with source and serial")
        plan_sources(rig)
        self._rig = rig
        self._plans: dict[str, SourcePlan] = {}
        self._troubles: dict[str, str] = {}
        # Registration at the time at which a source's space moved: with it, the source's poses are wrong.
        self._outdated: dict[str, RegistrationFile] = {}
        self._config = ObjectsConfig(objects=rig.config.objects)

    @property
    def config(self) -> ObjectsConfig:
        """The objects of the rig."""
        return self._config

    def reconfigure(self, config: BaseModel) -> None:
        """Refuse all changes: objects are configured in `rig.toml`.

        Raises:
            ConfigError: always.
        """
        raise ConfigError("objects are named in rig.toml; change it there and restart this service")

    def attach(self, node: Node) -> None:
        """Add counts and problems to the status; an object's key is declared with its first pose."""
        node.status.include(self._counts)
        node.status.watch(self._figures)

    def _counts(self) -> dict[str, int]:
        return {"unusable": sum(plan.core.unusable for plan in self._plans.values())}

    def _figures(self) -> tuple[Mapping[str, float], str]:
        return {}, "; ".join(self._troubles.values())

    async def run(self, node: Node, start: Control) -> None:
        """Read all sources until cancelled; a missing one does not delay the others."""
        rig = latest_rig(self._rig)
        self._troubles.clear()
        self._plans = {plan.name: plan for plan in plan_sources(rig)}
        async with asyncio.TaskGroup() as tasks:
            for name in self._plans:
                tasks.create_task(self._follow(node, start, name, rig.registration_of(source_kind(name))))

    async def _follow(self, node: Node, start: Control, name: str, registration: RegistrationFile) -> None:
        device = DeviceThread(name)
        if self._outdated.get(name) == registration:
            # Poses are still published, because a new registration needs them.
            self._trouble(
                name,
                f"the space of {name} has moved since it was registered, so all its poses are wrong until it "
                "is registered again: `rhot calibrate objects --live` (a few places are enough with --realign)",
            )
        else:
            self._outdated.pop(name, None)
        try:
            while True:
                source, moved = self._plans[name].source, False
                try:
                    await device.call("open", partial(source.open, start.start_t_ns), OPEN_LIMIT_S)
                    await self._poll(node, name, device)
                except SpaceMovedError as error:
                    self._failed(node, name, error)
                    self._outdated[name], moved = registration, True
                except DeviceError as error:
                    self._failed(node, name, error)
                finally:
                    await self._close(name, device)
                if moved:
                    registration = await self._reregistered(name, registration)
                else:
                    await asyncio.sleep(_RETRY_S)
        finally:
            device.end()

    async def _close(self, name: str, device: DeviceThread) -> None:
        try:
            await device.call("close", self._plans[name].source.close, CLOSE_LIMIT_S)
        except DeviceError as error:
            logger.warning("%s", error)

    def _failed(self, node: Node, name: str, error: DeviceError) -> None:
        node.status.count("device_errors")
        node.status.error(str(error))
        self._trouble(name, str(error))

    def _trouble(self, name: str, text: str) -> None:
        if self._troubles.get(name) != text:
            logger.warning("%s: %s", name, text)
        self._troubles[name] = text

    async def _reregistered(self, name: str, old: RegistrationFile) -> RegistrationFile:
        """Wait for a new registration of a source, and use it."""
        while True:
            new = (await asyncio.to_thread(latest_rig, self._rig)).registration_of(source_kind(name))
            if new != old:
                break
            await asyncio.sleep(_RETRY_S)
        self._outdated.pop(name, None)
        plan = self._plans[name]
        self._plans[name] = dataclasses.replace(plan, core=plan.core.registered(Registration.from_file(new)))
        return new

    async def _poll(self, node: Node, name: str, device: DeviceThread) -> None:
        plan = self._plans[name]
        loop = asyncio.get_running_loop()
        period_s = 1.0 / plan.rate_hz
        due = loop.time()
        while True:
            samples = await device.call("read", partial(plan.source.read, node.clock.now_ns()), _READ_LIMIT_S)
            node.status.tick("reads")
            if name not in self._outdated:
                self._troubles.pop(name, None)
            for key, message in plan.core.feed(samples, node.clock.now_ns()):
                node.publish(key, message)
            # If reading is slower than the rate, missed readings are skipped.
            due = max(due + period_s, loop.time())
            await asyncio.sleep(due - loop.time())
