"""A bridge as a service: sends the feed's samples at the target's rate, in the target's axes."""

from __future__ import annotations

import asyncio
import logging
import time
from collections.abc import Mapping
from dataclasses import replace
from typing import Final

import numpy as np
from pydantic import BaseModel

from rhot.clock import SystemClock
from rhot.errors import ConfigError
from rhot.messages import Control, Event
from rhot.rig import BridgeConfig, BusConfig
from rhot.service import Node
from rhot.service.runner import serve
from rhot_bridge.axes import Converter
from rhot_bridge.feed import Feed
from rhot_bridge.newest import Newest, Pace
from rhot_bridge.output import SampleOutput, check_settings, make_output
from rhot_bridge.scene import Tracked

logger = logging.getLogger(__name__)

_REPEAT_NS: Final = 100_000_000
"""A frame is repeated at this interval while no samples come: other programs treat longer pauses as a loss."""
_FIXED: Final = ("target", "host", "port", "axes", "transport", "body", "height_m", "allow_origins")
"""Settings that cannot change while the bridge runs."""


class BridgeService:
    """One bridge; implements `rhot.service.Service` and the feed's `Listener`."""

    name = "bridge"
    owns_clock = False

    def __init__(self, instance: str, config: BridgeConfig, feed: Feed) -> None:
        """Create the output.

        Args:
            instance: the bridge's name on the bus.
            config: target and settings.
            feed: shared by all bridges of this process.

        Raises:
            ConfigError: see `make_output`.
        """
        self.instance = instance
        self._config = config
        self._feed = feed
        self._output = make_output(config)
        self._recorder = self._output if isinstance(self._output, SampleOutput) else None
        self._newest = Newest(config)
        self._pace = Pace(config.rate_hz, self._output.triggers)
        self._converter = feed.converter(self._output.axes)
        # Fingers turn against their hand, so any rigid frame in place of the floor's gives the same.
        is_fingers = config.target == "vmc" and config.body == "fingers"
        self._floorless = Converter(self._output.axes, np.eye(4)) if is_fingers else None
        self._node: Node | None = None
        self._running = False
        self._warned_of_floor = False

    @property
    def config(self) -> BridgeConfig:
        """The configuration in force."""
        return self._config

    def reconfigure(self, config: BaseModel) -> None:
        """Change the rate and the treatment of predicted and absent samples.

        Raises:
            ConfigError: a setting that is fixed while the bridge runs, or has no effect on the target.
        """
        if not isinstance(config, BridgeConfig):
            raise TypeError(f"{type(config).__name__} is not a BridgeConfig")
        changed = [name for name in _FIXED if getattr(config, name) != getattr(self._config, name)]
        if changed:
            raise ConfigError(f"{', '.join(changed)}: fixed while the bridge runs; change rig.toml and start it again")
        check_settings(config)
        self._config = self._newest.config = config
        self._pace = Pace(config.rate_hz, self._output.triggers)
        if self._recorder is not None:
            self._recorder.use_config(config)

    def attach(self, node: Node) -> None:
        """Join the feed."""
        self._node = node
        if self._recorder is not None:
            self._recorder.use_clock(node.clock)
        node.status.watch(self._figures)
        self._feed.attach(node, self)

    def _figures(self) -> tuple[Mapping[str, float], str]:
        missing = self._converter is None and self._floorless is None and self._running
        return {}, self._no_floor() if missing else self._output.problem if self._running else ""

    def _no_floor(self) -> str:
        sent = "nothing is" if self._floorless is None else "only fingers are"
        return f"no floor frame is known (rhot/space/stage), so {sent} sent; make one: `rhot calibrate stage`" + (
            "; or send the rig's own axes: --axes rig" if self._config.target in ("json", "lsl", "ros2") else ""
        )

    async def run(self, node: Node, start: Control) -> None:
        """Send until cancelled."""
        self._newest.clear()
        await self._output.open()
        logger.info("bridge %s: %s", self.instance, self._output.where)
        self._running = True
        try:
            async with asyncio.TaskGroup() as tasks:
                if self._recorder is not None:
                    tasks.create_task(self._pass_on_events(self._recorder, node))
                await self._repeat()
        finally:
            self._running = False
            await self._output.close()

    async def _repeat(self) -> None:
        """Send again what does not change, and what fades."""
        while True:
            # Fading needs the full rate; otherwise the repetition interval is enough.
            await asyncio.sleep(1.0 / self._config.rate_hz if self._newest.fading else _REPEAT_NS / 2e9)
            now_ns = time.monotonic_ns()
            if self._newest.fading or now_ns - self._pace.sent_ns >= _REPEAT_NS:
                self._send(now_ns, None)

    @staticmethod
    async def _pass_on_events(output: SampleOutput, node: Node) -> None:
        async for event in node.receive(node.bus.events("rhot/event"), Event):
            if output.send_event(event):
                node.status.tick("events")

    def add_sample(self, key: str, tracked: Tracked, arrived_ns: int) -> None:
        """Store a sample of the feed."""
        self._newest.put(key, tracked, arrived_ns)
        if self._running and self._recorder is not None:
            self._pass_on(self._recorder, key, tracked, arrived_ns)

    def _pass_on(self, output: SampleOutput, key: str, tracked: Tracked, arrived_ns: int) -> None:
        node = self._node
        if node is None or self._converter is None:
            self._warn_of_missing_floor()
        elif output.send_sample(key, self._converter.poses(tracked)):
            node.status.tick("output")
            node.status.latency("to_wire", (time.monotonic_ns() - arrived_ns) / 1e9)

    def update_complete(self, kind: str, arrived_ns: int) -> None:
        """Send a frame if this kind triggers one and the rate limit allows it."""
        if self._running:
            self._send(time.monotonic_ns(), kind, arrived_ns)

    def stage_changed(self) -> None:
        """Use the converter to the present stage."""
        self._converter = self._feed.converter(self._output.axes)

    def _send(self, now_ns: int, kind: str | None, arrived_ns: int = 0) -> None:
        node = self._node
        if node is None or not self._pace.due(now_ns, kind) or not self._output.wanted(now_ns):
            return
        self._pace.sent(now_ns)
        scene = self._newest.scene(now_ns)
        if self._converter is not None:
            scene = self._converter.scene(scene)
        else:
            self._warn_of_missing_floor()
            if self._floorless is None:
                return
            scene = self._floorless.scene(replace(scene, objects={}, head=None, feet={}, body=None))
        sent, lost = self._output.send(scene, now_ns)
        if sent:
            node.status.tick("output")
        if lost:
            node.status.count("lost", lost)
        if sent and kind is not None:
            node.status.latency("to_wire", (time.monotonic_ns() - arrived_ns) / 1e9)
            if node.clock.ready:
                node.status.latency("output_age", (node.clock.now_ns() - scene.t_ns) / 1e9)

    def _warn_of_missing_floor(self) -> None:
        if not self._warned_of_floor:
            self._warned_of_floor = True
            logger.warning("bridge %s: %s", self.instance, self._no_floor())


async def serve_bridges(bridges: Mapping[str, BridgeConfig], bus_config: BusConfig) -> int:
    """Run bridges in this process until SIGINT or SIGTERM and return the exit code.

    Raises:
        RhotError: as `serve`.
    """
    feed = Feed()
    services = [BridgeService(name, config, feed) for name, config in bridges.items()]
    feeding = asyncio.create_task(feed.run())
    serving = asyncio.create_task(serve(services, bus_config, SystemClock()))
    try:
        done, _ = await asyncio.wait((feeding, serving), return_when=asyncio.FIRST_COMPLETED)
        if feeding in done:
            feeding.result()
        return await serving
    finally:
        for task in (feeding, serving):
            task.cancel()
        await asyncio.gather(feeding, serving, return_exceptions=True)
