"""One run of the whole simulated rig: processes, start signal, live table, report."""

from __future__ import annotations

import asyncio
import gc
import socket
import sys
import time
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import Any, Final

import numpy as np
from rich.console import Console
from rich.live import Live

from rhot.bus import Bus
from rhot.cli.control import broadcast
from rhot.cli.status import fetch_status, status_table
from rhot.evaluate.accuracy import seconds_since
from rhot.evaluate.collect import Collected, collect
from rhot.evaluate.coverage import coverage
from rhot.evaluate.figures import latency_parts, service_figures, tracking_figures
from rhot.evaluate.table import live_table
from rhot.messages import ServiceStatus
from rhot.rig import Rig
from rhot.sim.coverage import MarkerCoverage
from rhot.sim.folder import true_cameras
from rhot.sim.processes import service_commands, with_processes
from rhot.sim.world import World

_START_DELAY_S: Final = 1.0
_STEADY_FROM_S: Final = 3.0
"""Figures are taken from here on: caches are warm, every filter has started."""
_SHOW_EVERY_S: Final = 0.5
_LIVE_WINDOW_S: Final = 2.0
_LINE_EVERY_S: Final = 5.0
_COVERAGE_MOMENTS: Final = 200
_SWITCH_S: Final = 0.0005


class SimRun:
    """A simulated rig, run once."""

    def __init__(
        self, rig: Rig, endpoint: str, duration_s: float, work: Path, page: Sequence[str] | None = None
    ) -> None:
        """Prepare a run.

        Args:
            rig: a simulated rig.
            endpoint: where the router of this run listens.
            duration_s: seconds from start to stop.
            work: folder for logs.
            page: the command that opens the web page, see `service_commands`.
        """
        self._rig = rig
        self._page = page
        self._endpoint = endpoint
        self._duration_s = duration_s
        self._logs = work
        self._world = World.from_rig(rig)
        self._collected = Collected()
        self._start_t_ns = 0
        self._before: dict[str, ServiceStatus] = {}
        self._after: dict[str, ServiceStatus] = {}
        self._steady_from_s = min(_STEADY_FROM_S, 0.3 * duration_s)

    @property
    def _services(self) -> dict[str, list[str]]:
        """Names on the bus and the commands that run them."""
        names = ["fusion", "ik", "truth", *(["objects"] if self._rig.config.objects else [])]
        return service_commands(self._rig, self._endpoint, names, self._page)

    async def execute(self, console: Console, *, live: bool) -> None:
        """Start everything, run for the duration, end everything.

        Raises:
            RhotError: the router or a service did not come up, or one ended by itself.
        """
        # This process takes the time of arrival of every pose: neither its table nor the collector, which would look
        # through all that was received so far again and again, may hold that up.
        sys.setswitchinterval(_SWITCH_S)
        gc.disable()
        try:
            await with_processes(self._endpoint, self._services, self._logs, partial(self._follow, console, live))
        finally:
            gc.enable()

    async def _follow(self, console: Console, live: bool, bus: Bus) -> None:
        async with asyncio.TaskGroup() as tasks:
            collecting = tasks.create_task(collect(bus, self._collected, time.time_ns))
            control = await broadcast(bus, "start", "sim", _START_DELAY_S, wait_s=5.0)
            self._start_t_ns = control.start_t_ns
            await self._show(bus, console, live)
            self._after = (await fetch_status(bus))[1]
            await broadcast(bus, "stop", "sim", 0.0, wait_s=5.0)
            collecting.cancel()

    def _elapsed_s(self) -> float:
        return (time.time_ns() - self._start_t_ns) / 1e9

    async def _show(self, bus: Bus, console: Console, live: bool) -> None:
        """Show how it goes until the duration is over."""
        with Live(console=console, auto_refresh=False, transient=False) if live else _Quiet() as display:
            next_line_s = _LINE_EVERY_S
            while (elapsed_s := self._elapsed_s()) < self._duration_s:
                if not self._before and elapsed_s >= self._steady_from_s:
                    self._before = (await fetch_status(bus, timeout_s=0.5))[1]
                if isinstance(display, Live):
                    services = status_table(*await fetch_status(bus, timeout_s=0.5))
                    figures = self._recent(elapsed_s)
                    display.update(live_table(max(elapsed_s, 0.0), self._duration_s, figures, services), refresh=True)
                elif elapsed_s >= next_line_s:
                    console.print(_line(elapsed_s, self._duration_s, self._recent(elapsed_s)), soft_wrap=True)
                    next_line_s += _LINE_EVERY_S
                await asyncio.sleep(min(_SHOW_EVERY_S, max(0.0, self._duration_s - self._elapsed_s())))

    def _recent(self, elapsed_s: float) -> dict[str, Any]:
        from_s = elapsed_s - _LIVE_WINDOW_S
        return tracking_figures(self._world, self._start_t_ns, self._collected, from_s, elapsed_s)

    def report(self) -> dict[str, Any]:
        """Return every figure of the run, JSON-ready."""
        from_s, to_s = self._steady_from_s, self._duration_s
        config = self._rig.config
        figures = tracking_figures(self._world, self._start_t_ns, self._collected, from_s, to_s)
        services = service_figures(self._before, self._after)
        if "latency_ms" in figures:
            figures["latency_ms"]["parts"] = latency_parts(services["services"])
        points = self._collected.points
        covered = coverage(
            {name: MarkerCoverage(camera, self._world) for name, camera in true_cameras(self._rig).items()},
            np.linspace(from_s, to_s - 0.25, _COVERAGE_MOMENTS),
            points,
            seconds_since(self._start_t_ns, [sample.t_ns for sample in points]),
        )
        return {
            "version": 1,
            "duration_s": self._duration_s,
            "steady_from_s": from_s,
            "seed": config.sim.seed,
            "cameras": list(config.cameras),
            "camera_rate_hz": next(iter(config.cameras.values())).rate_hz,
            "method": config.fusion.method,
            "coverage": covered.measured,
            "coverage_reported": covered.reported,
            "coverage_samples": covered.samples,
            "coverage_by_marker": covered.by_marker,
            **figures,
            "missed": sum(service["counts"].get("missed", 0) for service in services["services"].values()),
            **services,
        }


class _Quiet:
    """Stands where the live table would."""

    def __enter__(self) -> _Quiet:
        return self

    def __exit__(self, *_: object) -> None:
        return


def _line(elapsed_s: float, duration_s: float, figures: dict[str, Any]) -> str:
    tips, latency = figures["fingertip_error_mm"], figures.get("latency_ms", {})
    if "median" not in tips or not latency:
        return f"{elapsed_s:5.1f} of {duration_s:.0f} s   no hand"
    return (
        f"{elapsed_s:5.1f} of {duration_s:.0f} s   {figures['rate_hz']:.0f} poses/s   "
        f"fingertips {tips['median']:.1f} mm (p95 {tips['p95']:.1f})   "
        f"latency {latency['p50']:.1f} ms (p99 {latency['p99']:.1f})"
    )


def free_endpoint(preferred: str) -> str:
    """Return the preferred TCP endpoint, or one with a free port where that is taken."""
    host, _, port = preferred.removeprefix("tcp/").rpartition(":")
    for number in (int(port), 0):
        with socket.socket() as probe:
            probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            try:
                probe.bind((host, number))
            except OSError:
                continue
            return f"tcp/{host}:{probe.getsockname()[1]}"
    return preferred
