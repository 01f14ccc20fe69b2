"""A simulated run that somebody watches: processes, start signal, a live table or a line now and then, stop."""

from __future__ import annotations

import asyncio
import time
from abc import ABC, abstractmethod
from collections.abc import Callable, Coroutine, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any, Final

from rich.console import Console, RenderableType
from rich.live import Live
from rich.status import Status

from rhot.bus import Bus, EventSubscriber
from rhot.messages import Control, ServiceStatus
from rhot.operation.control import broadcast
from rhot.operation.status import fetch_status, status_table
from rhot.rig import Rig
from rhot.rig.folder import latest_rig
from rhot.service.control_link import CONTROL_KEY
from rhot_sim.running.processes import bus_of, service_commands, with_processes

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
            following = tasks.create_task(self._follow_starts(controls, console))
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

    async def _follow_starts(self, controls: EventSubscriber, console: Console) -> None:
        """Start over with each session that somebody else begins: its world begins anew, too."""
        async for _, control in controls.messages(Control):
            if control.action == "start" and control.start_t_ns != self._start_t_ns:
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
        self._start_mono_ns = time.monotonic_ns() + control.start_t_ns - time.time_ns()

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
