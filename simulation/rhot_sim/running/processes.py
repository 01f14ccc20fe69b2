"""The processes of a simulated rig: router, services, and how all of them end together."""

from __future__ import annotations

import asyncio
import gc
import os
import socket
import sys
import time
from abc import ABC, abstractmethod
from collections.abc import Awaitable, Callable, Coroutine, Iterable, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any, Final

import numpy as np
from rich.console import Console, RenderableType
from rich.live import Live
from rich.status import Status

from rhot.bus import Bus, EventSubscriber
from rhot.clock import difference_ns
from rhot.errors import BusError
from rhot.messages import Control, ServiceStatus
from rhot.operation.control import broadcast
from rhot.operation.status import fetch_status, status_table
from rhot.operation.supervisor import Supervisor
from rhot.rig import BusConfig, Rig
from rhot.rig.folder import latest_rig
from rhot.service.control import CONTROL_KEY
from rhot_sim.comparison.accuracy import coverage, seconds_since
from rhot_sim.comparison.collect import Collected, collect
from rhot_sim.comparison.figures import latency_parts, live_table, service_figures, tracking_figures
from rhot_sim.rendering.coverage import MarkerCoverage
from rhot_sim.rig.calibration import true_cameras
from rhot_sim.world.world import World

# A simulated run that somebody watches: processes, start signal, a live table or a line now and then, stop.

_START_DELAY_S: Final = 1.0
_STEADY_FROM_S: Final = 3.0
"""Figures are taken from here on: caches are warm, every filter has started."""
_LIVE_WINDOW_S: Final = 2.0
_LINE_EVERY_S: Final = 5.0


class WatchedRun(ABC):
    """A simulated rig, run once; what is collected of it and how that is shown is the subclass's."""

    def __init__(
        self,
        rig: Rig,
        endpoint: str,
        duration_s: float,
        work: Path,
        names: Sequence[str],
        pages: Mapping[str, Sequence[str]] | None,
    ) -> None:
        """Prepare a run.

        Args:
            rig: a simulated rig.
            endpoint: where the router of this run listens.
            duration_s: seconds from start to stop.
            work: folder for logs.
            names: of the services beside capture.
            pages: the commands that open web pages, see `service_commands`.
        """
        self._rig = rig
        self._endpoint = endpoint
        self._duration_s = duration_s
        self._logs = work
        self._services = service_commands(rig, endpoint, names, pages)
        self._start_t_ns = 0
        self._start_mono_ns = time.monotonic_ns()
        self._before: dict[str, ServiceStatus] = {}
        self._after: dict[str, ServiceStatus] = {}
        self._steady_from_s = min(_STEADY_FROM_S, 0.3 * duration_s)

    @abstractmethod
    def _begin(self, rig: Rig) -> None:
        """Take the world of a rig, and forget what was collected in another one."""

    @abstractmethod
    def _collect(self, bus: Bus) -> Coroutine[Any, Any, None]:
        """Keep what arrives, until cancelled."""

    @abstractmethod
    def _figures(self, from_s: float, to_s: float) -> dict[str, Any]:
        """Return the figures between two times of the run, seconds since its start."""

    @abstractmethod
    def _table(self, elapsed_s: float, figures: dict[str, Any], services: RenderableType) -> RenderableType:
        """Return what is shown of the newest figures where a table can be."""

    @abstractmethod
    def _line(self, figures: dict[str, Any]) -> str:
        """Return what is said of the newest figures where a table cannot be shown."""

    @abstractmethod
    def report(self) -> dict[str, Any]:
        """Return every figure of the run, JSON-ready."""

    async def execute(
        self,
        console: Console,
        *,
        live: bool,
        announce: Sequence[str] = (),
        stay: Callable[[], None] | None = None,
    ) -> None:
        """Start everything, run for the duration, end everything.

        Args:
            console: where it is shown.
            live: with a table that is redrawn, instead of a line now and then.
            announce: what is said once everything is up, such as where the pages are.
            stay: called after the duration, to show the summary; the rig then runs on until cancelled. None = it ends.

        Raises:
            RhotError: the router or a service did not come up, or one ended by itself.
        """
        with console.status("starting router, cameras, tracker and pages") as starting:
            follow = partial(self._follow, console, live, announce, stay, starting)
            await with_processes(bus_of(self._rig, self._endpoint), self._services, self._logs, follow)

    async def _follow(
        self,
        console: Console,
        live: bool,
        announce: Sequence[str],
        stay: Callable[[], None] | None,
        starting: Status,
        bus: Bus,
    ) -> None:
        starting.stop()
        for line in announce:
            console.print(line, soft_wrap=True)
        async with asyncio.TaskGroup() as tasks:
            collecting = tasks.create_task(self._collect(bus))
            controls = bus.events(CONTROL_KEY)
            control = await broadcast(bus, "start", "sim", _START_DELAY_S, wait_s=5.0)
            self._start_at(control)
            following = tasks.create_task(self._follow_starts(control, controls, console))
            if live:
                with Live(console=console, auto_refresh=False) as display:
                    await self._show(bus, console, display)
            else:
                await self._show(bus, console, None)
            self._after = (await fetch_status(bus))[1]
            collecting.cancel()
            following.cancel()
            if stay is not None:
                stay()
                await asyncio.Event().wait()
            # Of whichever session: the page and `rhot start` begin others.
            await broadcast(bus, "stop", "", 0.0, wait_s=5.0)

    async def _follow_starts(self, newest: Control, controls: EventSubscriber, console: Console) -> None:
        """Start over with each session that somebody begins after `newest`: its world begins anew, too."""
        async for _, control in controls.messages(Control):
            if control.action == "start" and (control.revision, control.t_ns) > (newest.revision, newest.t_ns):
                newest = control
                self._rig = latest_rig(self._rig)
                self._begin(self._rig)
                self._start_at(control)
                self._before = {}
                console.print(
                    f"session {control.session} was started: the {self._duration_s:g} s count from here",
                    soft_wrap=True,
                    markup=False,
                )

    def _start_at(self, control: Control) -> None:
        self._start_t_ns = control.start_t_ns
        self._start_mono_ns = control.start_t_ns + difference_ns(time.monotonic_ns, time.time_ns)

    def _elapsed_s(self) -> float:
        # On a clock that nobody sets: a machine may learn the time of day meanwhile.
        return (time.monotonic_ns() - self._start_mono_ns) / 1e9

    async def _show(self, bus: Bus, console: Console, display: Live | None) -> None:
        """Show how it goes until the duration is over."""
        next_line_s = _LINE_EVERY_S
        while (elapsed_s := self._elapsed_s()) < self._duration_s:
            if not self._before and elapsed_s >= self._steady_from_s:
                self._before = (await fetch_status(bus, timeout_s=0.5))[1]
            if display is not None:
                services = status_table(*await fetch_status(bus, timeout_s=0.5))
                figures = self._figures(elapsed_s - _LIVE_WINDOW_S, elapsed_s)
                display.update(self._table(max(elapsed_s, 0.0), figures, services), refresh=True)
            elif elapsed_s >= next_line_s:
                line = self._line(self._figures(elapsed_s - _LIVE_WINDOW_S, elapsed_s))
                console.print(f"{elapsed_s:5.1f} of {self._duration_s:.0f} s   {line}", soft_wrap=True)
                next_line_s += _LINE_EVERY_S
            elif elapsed_s < next_line_s - _LINE_EVERY_S:
                next_line_s = _LINE_EVERY_S  # another session was started
            show_every_s = 0.5
            await asyncio.sleep(min(show_every_s, max(0.0, self._duration_s - self._elapsed_s())))


# One run of the whole simulated rig: what is collected, shown and reported of it.

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


_UP_LIMIT_S: Final = 30.0


def service_commands(
    rig: Rig, endpoint: str, names: Iterable[str], pages: Mapping[str, Sequence[str]] | None = None
) -> dict[str, list[str]]:
    """Return the commands that run a rig's capture services and the other services named, by their names on the bus.

    Args:
        rig: loaded.
        endpoint: of the router.
        names: of the services beside capture.
        pages: name on the bus and command of each web page, without the rig's own options.
    """
    options = ["--rig", str(rig.path), "--connect", endpoint]
    services = {f"capture/{name}": ["capture", "--camera", name, *options] for name in rig.config.cameras}
    services |= {f"{name}/main": [name, *options] for name in names}
    return services | {name: [*command, *options] for name, command in (pages or {}).items()}


def bus_of(rig: Rig, endpoint: str) -> BusConfig:
    """Return how this process meets a rig's services at a router: in the namespace that they find for themselves."""
    return BusConfig(connect=(endpoint,), namespace=os.environ.get("RHOT_NAMESPACE") or rig.config.bus.namespace)


async def with_processes(
    bus_config: BusConfig, services: Mapping[str, Sequence[str]], logs: Path, work: Callable[[Bus], Awaitable[None]]
) -> None:
    """Run a router in this process and services beside it, wait until all are there, do the work, end everything.

    Args:
        bus_config: how the services are met, see `bus_of`; the router listens where it connects.
        services: name on the bus and command of each.
        logs: folder for their output.
        work: done while they run.

    Raises:
        RhotError: the router or a service did not come up, or one ended by itself.
    """
    supervisor = Supervisor(logs)
    router = BusConfig(mode="router", connect=(), listen=bus_config.connect)
    try:
        async with await Bus.open(router), await Bus.open(bus_config) as bus:
            for name, arguments in services.items():
                await supervisor.start(name.replace("/", " "), arguments)
            working = asyncio.create_task(_when_up(bus, set(services), work))
            failed = asyncio.create_task(supervisor.wait_for_failure())
            try:
                await asyncio.wait((working, failed), return_when=asyncio.FIRST_COMPLETED)
                if failed.done():
                    raise supervisor.failure(failed.result())
                working.result()
            finally:
                working.cancel()
                failed.cancel()
                await asyncio.gather(working, failed, return_exceptions=True)
    finally:
        await supervisor.stop()


async def _when_up(bus: Bus, wanted: set[str], work: Callable[[Bus], Awaitable[None]]) -> None:
    deadline = time.monotonic() + _UP_LIMIT_S
    while True:
        alive, _ = await fetch_status(bus, timeout_s=0.5)
        if wanted <= alive:
            break
        if time.monotonic() > deadline:
            raise BusError(
                f"{', '.join(sorted(wanted - alive))} did not come up within {_UP_LIMIT_S:.0f} s; is this machine "
                "overloaded?"
            )
        await asyncio.sleep(0.1)
    await work(bus)
