"""A simulated rig that runs for as long as somebody calibrates it."""

from __future__ import annotations

import asyncio
from collections.abc import Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Final

from rich.console import Console

from rhot.bus import Bus
from rhot.operation.control import broadcast
from rhot.rig import Rig
from rhot.rig.folder import CAMERAS_FILE
from rhot.text import as_argument
from rhot_sim.running.processes import bus_of, service_commands, with_processes
from rhot_sim.world.touching import WAIT_S

_START_DELAY_S: Final = 0.5
_BOARD_TEXT: Final = (
    "The cameras see a chessboard of {columns}x{rows} inner corners, {square_mm:g} mm squares.\nrig folder: {path}\n"
    "Now, in another terminal:\n\n"
    "  rhot calibrate cameras --live --rig {folder} --board {columns}x{rows} --square-mm {square_mm:g} "
    "--connect {endpoint}\n"
)
_DESK_TEXT: Final = (
    "A chessboard of {columns}x{rows} inner corners, {square_mm:g} mm squares, lies on the desk.\nrig folder: {path}\n"
    "Now, in another terminal:\n\n"
    "  rhot calibrate stage --live --rig {folder} --board {columns}x{rows} --square-mm {square_mm:g} "
    "--desk-mm {desk_mm:g} --connect {endpoint}\n"
)
_TOUCH_TEXT: Final = (
    "A finger touches the faces of {object}, a box whose tracker sits askew. It waits {wait_s:.0f} s after each start "
    "signal, then touches them in the order in which the command asks.\nrig folder: {path}\n"
    "Now, in another terminal:\n\n"
    "  rhot start --connect {endpoint} && rhot calibrate objects --touch {object} --rig {folder} --connect {endpoint}\n"
)
_HEADSET_TEXT: Final = (
    "A marker lies on the floor, and somebody looks about over it. The camera sits askew on the headset.\n"
    "rig folder: {path}\nNow, in another terminal:\n\n"
    "  rhot calibrate headset --live --rig {folder} --connect {endpoint}\n"
)
_PATH_TEXT: Final = (
    "This rig is not calibrated yet (no {missing}). In the page, the tab Calibrate leads through it; what stands "
    "before the simulated cameras is chosen there, too.\n"
)


def missing_calibration(rig: Rig) -> str:
    """Return which files a simulated rig must have before it tracks and does not; empty when none is missing."""
    return ", ".join(file.name for file in (rig.colors_path, rig.path / CAMERAS_FILE) if not file.exists())


async def run_for_calibration(
    rig: Rig,
    endpoint: str,
    duration_s: float | None,
    work: Path,
    console: Console,
    pages: Mapping[str, Sequence[str]] | None = None,
    announce: Sequence[str] = (),
) -> None:
    """Run router and all services until the time is over or cancelled, and say what to do.

    Args:
        rig: a simulated rig, with a board before its cameras or not calibrated.
        endpoint: where the router listens.
        duration_s: seconds to run; None = until cancelled.
        work: folder for logs.
        console: takes what to do next.
        pages: the commands that open web pages, see `service_commands`.
        announce: what is said once everything is up, such as where the page is.

    Raises:
        RhotError: the router or a service did not come up, or one ended by itself.
    """
    tracking = "fusion" if rig.config.cameras else "feet"
    names = [tracking, "ik", "truth", *(["objects"] if rig.config.objects else [])]
    services = service_commands(rig, endpoint, names, pages)
    stay = partial(_stay, rig, endpoint, duration_s, console, announce)
    await with_processes(bus_of(rig, endpoint), services, work, stay)


async def _stay(
    rig: Rig, endpoint: str, duration_s: float | None, console: Console, announce: Sequence[str], bus: Bus
) -> None:
    for line in announce:
        console.print(line, soft_wrap=True)
    await broadcast(bus, "start", "calibrate", _START_DELAY_S, wait_s=5.0)
    sim = rig.config.sim
    if sim.motion in ("board", "desk_board"):
        text = (_BOARD_TEXT if sim.motion == "board" else _DESK_TEXT).format(
            columns=sim.board_columns,
            rows=sim.board_rows,
            square_mm=1e3 * sim.board_square_m,
            desk_mm=1e3 * sim.desk_height_m,
            path=rig.path,
            folder=as_argument(rig.path),
            endpoint=endpoint,
        )
    elif sim.motion == "touch":
        touched = next(name for name, item in rig.config.objects.items() if item.source == "simulated")
        text = _TOUCH_TEXT.format(
            object=touched, wait_s=WAIT_S, path=rig.path, folder=as_argument(rig.path), endpoint=endpoint
        )
    elif sim.motion == "headset":
        text = _HEADSET_TEXT.format(path=rig.path, folder=as_argument(rig.path), endpoint=endpoint)
    else:
        text = _PATH_TEXT.format(missing=missing_calibration(rig))
    ending = "Ctrl-C ends it." if duration_s is None else f"Ends after {duration_s:g} s."
    console.print(f"{text}\n{ending}", soft_wrap=True, highlight=False, markup=False)
    if duration_s is None:
        await asyncio.Event().wait()
    else:
        await asyncio.sleep(_START_DELAY_S + duration_s)
    # Whoever calibrated may have started sessions of their own: all of them end.
    await broadcast(bus, "stop", "", 0.0, wait_s=5.0)
