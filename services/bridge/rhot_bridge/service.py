"""A bridge as a service: what the feed brings goes out at the target's pace, in the target's axes."""

from __future__ import annotations

import asyncio
import logging
import time
from collections.abc import Mapping
from typing import Final

from pydantic import BaseModel

from rhot.clock import SystemClock
from rhot.errors import ConfigError
from rhot.messages import Control
from rhot.rig import BridgeConfig, BusConfig
from rhot.service import Node
from rhot.service.runner import serve
from rhot_bridge.feed import Feed
from rhot_bridge.newest import Newest
from rhot_bridge.output import SampleOutput, make_output, refuse_meaningless
from rhot_bridge.pace import Pace
from rhot_bridge.scene import Tracked

logger = logging.getLogger(__name__)

_REPEAT_NS: Final = 100_000_000
"""While nothing comes, a frame is repeated ten times a second: other programs take longer silence for a loss."""
_FIXED: Final = ("target", "host", "port", "axes", "transport", "body", "height_m", "allow_origins")
"""Settings that are fixed when the bridge is made."""


class BridgeService:
    """One bridge; see `rhot.service.Service` for the seam, and `Listener` of the feed."""

    name = "bridge"
    owns_clock = False

    def __init__(self, instance: str, config: BridgeConfig, feed: Feed) -> None:
        """Prepare.

        Args:
            instance: its name on the bus.
            config: what is sent where.
            feed: of this process.

        Raises:
            ConfigError: see `make_output`.
        """
        self.instance = instance
        self._config = config
        self._feed = feed
        self._output = make_output(config)
        self._recorder = self._output if isinstance(self._output, SampleOutput) else None
        self._newest = Newest(config)
        self._pace = Pace(config.rate_hz, self._output.leads)
        self._converter = feed.converter(self._output.axes)
        self._node: Node | None = None
        self._running = False
        self._warned_of_floor = False

    @property
    def config(self) -> BridgeConfig:
        """The configuration in force."""
        return self._config

    def reconfigure(self, config: BaseModel) -> None:
        """Change the rate, and what is sent of what is not tracked; the rest is fixed when the bridge starts."""
        if not isinstance(config, BridgeConfig):
            raise TypeError(f"{type(config).__name__} is not a BridgeConfig")
        changed = [name for name in _FIXED if getattr(config, name) != getattr(self._config, name)]
        if changed:
            raise ConfigError(f"{', '.join(changed)}: fixed while the bridge runs; change rig.toml and start it again")
        refuse_meaningless(config)
        self._config = self._newest.config = config
        self._pace = Pace(config.rate_hz, self._output.leads)

    def attach(self, node: Node) -> None:
        """Join the feed."""
        self._node = node
        if self._recorder is not None:
            self._recorder.use_clock(node.clock)
        node.status.watch(self._figures)
        self._feed.attach(node, self)

    def _figures(self) -> tuple[Mapping[str, float], str]:
        missing = self._converter is None and self._running
        return {}, self._no_floor() if missing else self._output.problem if self._running else ""

    def _no_floor(self) -> str:
        return "no floor frame is known (rhot/space/stage), so nothing is sent; make one: `rhot calibrate stage`" + (
            "; or send the rig's own axes: --axes rig" if self._config.target in ("json", "lsl", "ros2") else ""
        )

    async def run(self, node: Node, start: Control) -> None:
        """Send until cancelled."""
        self._newest.clear()
        await self._output.open()
        logger.info("bridge %s: %s", self.instance, self._output.where)
        self._running = True
        try:
            while True:
                # What has gone fades smoothly; else a repetition is enough.
                await asyncio.sleep(1.0 / self._config.rate_hz if self._newest.fading else _REPEAT_NS / 2e9)
                now_ns = time.monotonic_ns()
                if self._newest.fading or now_ns - self._pace.sent_ns >= _REPEAT_NS:
                    self._send(now_ns, None)
        finally:
            self._running = False
            await self._output.close()

    def take(self, key: str, tracked: Tracked, arrived_ns: int) -> None:
        """Keep a sample of the feed."""
        self._newest.put(key, tracked, arrived_ns)
        if self._running and self._recorder is not None:
            self._pass_on(self._recorder, key, tracked, arrived_ns)

    def _pass_on(self, output: SampleOutput, key: str, tracked: Tracked, arrived_ns: int) -> None:
        node = self._node
        if node is None or self._converter is None:
            self._warn_of_missing_floor()
        elif output.take(key, self._converter.poses(tracked)):
            node.status.tick("output")
            node.status.latency("to_wire", (time.monotonic_ns() - arrived_ns) / 1e9)

    def moment(self, kind: str, arrived_ns: int) -> None:
        """Send if the target wants this kind's beat and the rate allows."""
        if self._running:
            self._send(time.monotonic_ns(), kind, arrived_ns)

    def floor(self) -> None:
        """Use the floor that is known now."""
        self._converter = self._feed.converter(self._output.axes)

    def _send(self, now_ns: int, kind: str | None, arrived_ns: int = 0) -> None:
        node = self._node
        if node is None or not self._pace.due(now_ns, kind) or not self._output.wanted(now_ns):
            return
        self._pace.sent(now_ns)
        if self._converter is None:
            self._warn_of_missing_floor()
            return
        scene = self._converter.scene(self._newest.scene(now_ns))
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
