"""One run of the whole simulated rig: what is collected, shown and reported of it."""

from __future__ import annotations

import gc
import socket
import sys
import time
from collections.abc import Callable, Coroutine, Mapping, Sequence
from pathlib import Path
from typing import Any, Final

import numpy as np
from rich.console import Console, RenderableType

from rhot.bus import Bus
from rhot.rig import Rig
from rhot_sim.comparison.accuracy import seconds_since
from rhot_sim.comparison.collect import Collected, collect
from rhot_sim.comparison.coverage import coverage
from rhot_sim.comparison.figures import latency_parts, service_figures, tracking_figures
from rhot_sim.comparison.table import live_table
from rhot_sim.rendering.coverage import MarkerCoverage
from rhot_sim.rig.folder import true_cameras
from rhot_sim.running.watched_run import WatchedRun
from rhot_sim.world.world import World

_SWITCH_S: Final = 0.0005


class SimRun(WatchedRun):
    """A simulated rig, run once."""

    def __init__(
        self, rig: Rig, endpoint: str, duration_s: float, work: Path, pages: Mapping[str, Sequence[str]] | None = None
    ) -> None:
        """Prepare a run; arguments as of `WatchedRun`."""
        names = ("fusion", "ik", "truth", *(("objects",) if rig.config.objects else ()))
        super().__init__(rig, endpoint, duration_s, work, names, pages)
        self._collected = Collected()
        self._begin(rig)

    async def execute(
        self,
        console: Console,
        *,
        live: bool,
        announce: Sequence[str] = (),
        stay: Callable[[], None] | None = None,
    ) -> None:
        """Start everything, run for the duration, end everything; see `WatchedRun.execute`."""
        # This process takes the time of arrival of every pose: neither its table nor the collector, which would look
        # through all that was received so far again and again, may hold that up.
        sys.setswitchinterval(_SWITCH_S)
        gc.disable()
        try:
            await super().execute(console, live=live, announce=announce, stay=stay)
        finally:
            gc.enable()

    def _begin(self, rig: Rig) -> None:
        self._world = World.from_rig(rig)
        self._collected.clear()

    def _collect(self, bus: Bus) -> Coroutine[Any, Any, None]:
        return collect(bus, self._collected, time.time_ns)

    def _figures(self, from_s: float, to_s: float) -> dict[str, Any]:
        return tracking_figures(self._world, self._start_t_ns, self._collected, from_s, to_s)

    def _table(self, elapsed_s: float, figures: dict[str, Any], services: RenderableType) -> RenderableType:
        return live_table(elapsed_s, self._duration_s, figures, services)

    def _line(self, figures: dict[str, Any]) -> str:
        tips, latency = figures["fingertip_error_mm"], figures.get("latency_ms", {})
        if "median" not in tips or not latency:
            return "no hand"
        return (
            f"{figures['rate_hz']:.0f} poses/s   "
            f"fingertips {tips['median']:.1f} mm (p95 {tips['p95']:.1f})   "
            f"latency {latency['p50']:.1f} ms (p99 {latency['p99']:.1f})"
        )

    def report(self) -> dict[str, Any]:
        """Return every figure of the run, JSON-ready."""
        from_s, to_s = self._steady_from_s, self._duration_s
        config = self._rig.config
        figures = self._figures(from_s, to_s)
        services = service_figures(self._before, self._after)
        if "latency_ms" in figures:
            figures["latency_ms"]["parts"] = latency_parts(services["services"])
        points, rate_hz = self._collected.points, next(iter(config.cameras.values())).rate_hz
        coverage_moments = 200
        covered = coverage(
            {name: MarkerCoverage(camera, self._world) for name, camera in true_cameras(self._rig).items()},
            np.linspace(from_s, to_s - 0.25, coverage_moments),
            points,
            seconds_since(self._start_t_ns, [sample.t_ns for sample in points]),
            rate_hz,
        )
        return {
            "version": 1,
            "duration_s": self._duration_s,
            "steady_from_s": from_s,
            "seed": config.sim.seed,
            "cameras": list(config.cameras),
            "camera_rate_hz": rate_hz,
            "method": config.fusion.method,
            "coverage": covered.measured,
            "coverage_reported": covered.reported,
            "coverage_samples": covered.samples,
            "coverage_by_marker": covered.by_marker,
            **figures,
            "missed": sum(service["counts"].get("missed", 0) for service in services["services"].values()),
            **services,
        }


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
