"""One run of the simulated walker: processes, start signal, live table, report."""

from __future__ import annotations

import asyncio
import time
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import Any, Final

from rich.console import Console
from rich.live import Live

from rhot.bus import Bus
from rhot.cli.control import broadcast
from rhot.cli.status import fetch_status, status_table
from rhot.errors import ConfigError
from rhot.evaluate.feet import CollectedFeet, collect_feet, feet_figures
from rhot.evaluate.feet_table import live_feet_table, stages_text
from rhot.evaluate.figures import service_figures
from rhot.messages import ServiceStatus
from rhot.rig import Rig
from rhot.sim.processes import service_commands, with_processes
from rhot.sim.walker.world import WalkerWorld

_START_DELAY_S: Final = 1.0
_STEADY_FROM_S: Final = 3.0
_SHOW_EVERY_S: Final = 0.5
_LIVE_WINDOW_S: Final = 2.0
_LINE_EVERY_S: Final = 5.0
_FEET: Final = "feet/main"


class WalkerRun:
    """A simulated walker, run once."""

    def __init__(
        self, rig: Rig, endpoint: str, duration_s: float, work: Path, page: Sequence[str] | None = None
    ) -> None:
        """Prepare a run.

        Args:
            rig: with `[feet]`, all simulated, and a simulated head.
            endpoint: where the router of this run listens.
            duration_s: seconds from start to stop.
            work: folder for logs.
            page: the command that opens the web page, see `service_commands`.

        Raises:
            ConfigError: the rig has no feet.
        """
        if rig.config.feet is None:
            raise ConfigError(f"{rig.path / 'rig.toml'} names no feet; add [feet.left] or [feet.right] with marker_id")
        self._rig = rig
        self._feet = rig.config.feet
        self._endpoint = endpoint
        self._duration_s = duration_s
        self._logs = work
        self._page = page
        self._world = WalkerWorld.from_rig(rig)
        self._collected = CollectedFeet()
        self._start_t_ns = 0
        self._before: dict[str, ServiceStatus] = {}
        self._after: dict[str, ServiceStatus] = {}
        self._steady_from_s = min(_STEADY_FROM_S, 0.3 * duration_s)

    async def execute(self, console: Console, *, live: bool) -> None:
        """Start everything, run for the duration, end everything.

        Raises:
            RhotError: the router or a service did not come up, or one ended by itself.
        """
        services = service_commands(self._rig, self._endpoint, ("feet", "ik", "objects", "truth"), self._page)
        await with_processes(self._endpoint, services, self._logs, partial(self._follow, console, live))

    async def _follow(self, console: Console, live: bool, bus: Bus) -> None:
        async with asyncio.TaskGroup() as tasks:
            collecting = tasks.create_task(collect_feet(bus, self._collected, time.time_ns))
            control = await broadcast(bus, "start", "sim", _START_DELAY_S, wait_s=5.0)
            self._start_t_ns = control.start_t_ns
            if live:
                with Live(console=console, auto_refresh=False) as display:
                    await self._show(bus, console, display)
            else:
                await self._show(bus, console, None)
            self._after = (await fetch_status(bus))[1]
            await broadcast(bus, "stop", "sim", 0.0, wait_s=5.0)
            collecting.cancel()

    async def _show(self, bus: Bus, console: Console, display: Live | None) -> None:
        """Show how it goes until the duration is over."""
        next_line_s = _LINE_EVERY_S
        while (elapsed_s := (time.time_ns() - self._start_t_ns) / 1e9) < self._duration_s:
            if not self._before and elapsed_s >= self._steady_from_s:
                self._before = (await fetch_status(bus, timeout_s=0.5))[1]
            if display is not None:
                services = status_table(*await fetch_status(bus, timeout_s=0.5))
                figures = self._figures(elapsed_s - _LIVE_WINDOW_S, elapsed_s)
                display.update(live_feet_table(max(elapsed_s, 0.0), self._duration_s, figures, services), refresh=True)
            elif elapsed_s >= next_line_s:
                figures = self._figures(elapsed_s - _LIVE_WINDOW_S, elapsed_s)
                console.print(_line(elapsed_s, self._duration_s, figures), soft_wrap=True)
                next_line_s += _LINE_EVERY_S
            await asyncio.sleep(min(_SHOW_EVERY_S, max(0.0, self._duration_s - elapsed_s)))

    def _figures(self, from_s: float, to_s: float) -> dict[str, Any]:
        return feet_figures(self._world, self._start_t_ns, self._collected, from_s, to_s)

    def report(self) -> dict[str, Any]:
        """Return every figure of the run, JSON-ready."""
        config = self._rig.config
        return {
            "version": 1,
            "duration_s": self._duration_s,
            "steady_from_s": self._steady_from_s,
            "seed": config.sim.seed,
            "walk": config.sim.walk,
            "height_m": config.body.height_m,
            "camera_rate_hz": self._feet.camera.rate_hz,
            "method": self._feet.method,
            **self._figures(self._steady_from_s, self._duration_s),
            **self._load(),
            **service_figures(self._before, self._after),
        }

    def _load(self) -> dict[str, float]:
        """Return the pictures per second that were tracked, and the cores taken beside drawing them."""
        before, after = self._before.get(_FEET), self._after.get(_FEET)
        if before is None or after is None:
            return {}
        seconds = max(after.uptime_s - before.uptime_s, 1e-3)
        taken = {name: after.figures.get(name, 0.0) - before.figures.get(name, 0.0) for name in after.figures}
        cores = (taken.get("processor_s", 0.0) - taken.get("camera_processor_s", 0.0)) / seconds
        pictures = after.counts.get("frames", 0) - before.counts.get("frames", 0)
        return {"pictures_hz": pictures / seconds, "feet_cores": cores}


def _line(elapsed_s: float, duration_s: float, figures: dict[str, Any]) -> str:
    error, latency = figures["foot_error_mm"], figures.get("latency_ms", {})
    if "median" not in error or not latency:
        return f"{elapsed_s:5.1f} of {duration_s:.0f} s   no foot"
    return (
        f"{elapsed_s:5.1f} of {duration_s:.0f} s   {figures['rate_hz']:.0f} poses/s   "
        f"feet {error['median']:.1f} mm (p95 {error['p95']:.1f})   latency {latency['p50']:.1f} ms   "
        f"{stages_text(figures)}"
    )
