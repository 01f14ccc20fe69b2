"""One run of the simulated walker: what is collected, shown and reported of it."""

from __future__ import annotations

import time
from collections.abc import Coroutine, Mapping, Sequence
from pathlib import Path
from typing import Any, Final

from rich.console import RenderableType

from rhot.bus import Bus
from rhot.errors import ConfigError
from rhot.rig import Rig
from rhot_sim.comparison.feet import CollectedFeet, collect_feet, feet_figures
from rhot_sim.comparison.feet_table import live_feet_table, stages_text
from rhot_sim.comparison.figures import service_figures
from rhot_sim.running.watched_run import WatchedRun
from rhot_sim.walker.world import WalkerWorld

_SERVICES: Final = ("feet", "ik", "objects", "truth")
_FEET: Final = "feet/main"


class WalkerRun(WatchedRun):
    """A simulated walker, run once."""

    def __init__(
        self, rig: Rig, endpoint: str, duration_s: float, work: Path, pages: Mapping[str, Sequence[str]] | None = None
    ) -> None:
        """Prepare a run; arguments as of `WatchedRun`, the rig with `[feet]` and a simulated head.

        Raises:
            ConfigError: the rig has no feet.
        """
        if rig.config.feet is None:
            raise ConfigError(f"{rig.path / 'rig.toml'} names no feet; add [feet.left] or [feet.right] with marker_id")
        super().__init__(rig, endpoint, duration_s, work, _SERVICES, pages)
        self._feet = rig.config.feet
        self._collected = CollectedFeet()
        self._begin(rig)

    def _begin(self, rig: Rig) -> None:
        self._world = WalkerWorld.from_rig(rig)
        self._collected.clear()

    def _collect(self, bus: Bus) -> Coroutine[Any, Any, None]:
        return collect_feet(bus, self._collected, time.time_ns)

    def _figures(self, from_s: float, to_s: float) -> dict[str, Any]:
        return feet_figures(self._world, self._start_t_ns, self._collected, from_s, to_s)

    def _table(self, elapsed_s: float, figures: dict[str, Any], services: RenderableType) -> RenderableType:
        return live_feet_table(elapsed_s, self._duration_s, figures, services)

    def _line(self, figures: dict[str, Any]) -> str:
        error, latency = figures["foot_error_mm"], figures.get("latency_ms", {})
        if "median" not in error or not latency:
            return "no foot"
        return (
            f"{figures['rate_hz']:.0f} poses/s   feet {error['median']:.1f} mm (p95 {error['p95']:.1f})   "
            f"latency {latency['p50']:.1f} ms   {stages_text(figures)}"
        )

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
