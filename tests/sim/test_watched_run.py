"""A simulated run that somebody watches, on a real bus, without the processes of a rig."""

from __future__ import annotations

import asyncio
import io
from collections.abc import Coroutine
from pathlib import Path
from typing import Any

from bus_watch import PATIENCE_S
from rich.console import Console, RenderableType

from rhot.bus import Bus
from rhot.messages import Control
from rhot.operation.control import broadcast
from rhot.rig import BusConfig, Rig, load_rig
from rhot.service.clock_sync import serve_clock
from rhot_sim.running.processes import WatchedRun

DURATION_S = 1.0


class Watched(WatchedRun):
    """Collects nothing, and counts the worlds that it is told to take."""

    worlds = 0

    def _begin(self, rig: Rig) -> None:
        self.worlds += 1

    def _collect(self, bus: Bus) -> Coroutine[Any, Any, None]:
        return asyncio.sleep(PATIENCE_S)

    def _figures(self, from_s: float, to_s: float) -> dict[str, Any]:
        return {}

    def _table(self, elapsed_s: float, figures: dict[str, Any], services: RenderableType) -> RenderableType:
        return ""

    def _line(self, figures: dict[str, Any]) -> str:
        return ""

    def report(self) -> dict[str, Any]:
        return {"start_t_ns": self._start_t_ns}


async def test_a_session_that_somebody_else_starts_is_compared_with_its_own_world(
    router: BusConfig, rig_folder: Path
) -> None:
    said = io.StringIO()
    console = Console(file=said, width=200)
    run = Watched(load_rig(rig_folder), router.connect[0], DURATION_S, rig_folder, (), None)
    async with await Bus.open(router) as bus, await Bus.open(router) as page:
        serve_clock(page)
        heard = page.events("rhot/control")
        with console.status("") as status:
            watching = asyncio.create_task(run._follow(console, False, (), None, status, bus))
            first = await asyncio.wait_for(anext(aiter(heard.messages(Control))), PATIENCE_S)
            second = await broadcast(page, "start", "page", 0.3, PATIENCE_S)
            await asyncio.wait_for(watching, PATIENCE_S)
    assert first[1].session == "sim"
    assert run.worlds == 1
    assert run.report() == {"start_t_ns": second.start_t_ns}
    assert "session page was started: the 1 s count from here" in said.getvalue()
