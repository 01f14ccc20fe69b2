"""Simulated cameras that look at a calibration board, for as long as somebody calibrates them."""

from __future__ import annotations

import asyncio
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import Final

from rich.console import Console

from rhot.bus import Bus
from rhot.cli.control import broadcast
from rhot.rig import Rig
from rhot.sim.processes import service_commands, with_processes

_START_DELAY_S: Final = 0.5


async def run_board(
    rig: Rig, endpoint: str, duration_s: float | None, work: Path, console: Console, page: Sequence[str] | None = None
) -> None:
    """Run router, capture services, the rig's clock (fusion) and the truth until the time is over or cancelled.

    Args:
        rig: a simulated rig with `motion = "board"`.
        endpoint: where the router listens.
        duration_s: seconds to run; None = until cancelled.
        work: folder for logs.
        console: takes what to type next.
        page: the command that opens the web page, see `service_commands`.

    Raises:
        RhotError: the router or a service did not come up, or one ended by itself.
    """
    services = service_commands(rig, endpoint, ("fusion", "truth"), page)
    await with_processes(endpoint, services, work, partial(_show_board, rig, endpoint, duration_s, console))


async def _show_board(rig: Rig, endpoint: str, duration_s: float | None, console: Console, bus: Bus) -> None:
    control = await broadcast(bus, "start", "board", _START_DELAY_S, wait_s=5.0)
    sim = rig.config.sim
    console.print(
        f"The cameras see a chessboard of {sim.board_columns}x{sim.board_rows} inner corners, "
        f"{1e3 * sim.board_square_m:g} mm squares.\nrig folder: {rig.path}\nNow, in another terminal:\n\n"
        f"  rhot calibrate cameras --live --rig {rig.path} --board {sim.board_columns}x{sim.board_rows} "
        f"--square-mm {1e3 * sim.board_square_m:g} --connect {endpoint}\n\n"
        f"{'Ctrl-C ends it.' if duration_s is None else f'Ends after {duration_s:g} s.'}",
        soft_wrap=True,
        highlight=False,
        markup=False,
    )
    if duration_s is None:
        await asyncio.Event().wait()
    else:
        await asyncio.sleep(_START_DELAY_S + duration_s)
    await broadcast(bus, "stop", control.session, 0.0, wait_s=5.0)
