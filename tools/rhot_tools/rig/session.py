"""A session with somebody at the rig: what to do is said, then it is listened."""

from __future__ import annotations

import asyncio
from collections.abc import Callable, Sequence
from typing import Final

import click
import numpy as np
from rich.console import Console

from rhot.arrays import ImageArray
from rhot.bus import Bus
from rhot.errors import ConfigError
from rhot.rig import BusConfig, Rig
from rhot_calibration.colors.live import decoded
from rhot_calibration.depth.fit import LEAST_ROWS
from rhot_tools.rig.depth import DepthRow, calibration_px, disparities, row_at, rows_by_truth
from rhot_tools.rig.heard import Heard, listen

_HOLD_S: Final = 3.0
_ANSWER_S: Final = 2.0
_CONNECT_S: Final = 5.0


def depth_session(
    rig: Rig,
    bus: BusConfig,
    marker: str,
    distances_cm: Sequence[float],
    ruler_m: float,
    console: Console,
    hold_s: float = _HOLD_S,
    ask: Callable[[str], str] = lambda text: str(click.prompt(text, default="", show_default=False)),
) -> list[DepthRow]:
    """Lead through distances and return a row for each; one that was not seen is asked for again or left out.

    Args:
        rig: whose cameras look.
        bus: how to reach it.
        marker: that is held before the cameras.
        distances_cm: where to hold it.
        ruler_m: what a distance may be off.
        console: to speak on.
        hold_s: how long it is looked at.
        ask: returns what somebody answers.
    """
    rows: list[DepthRow] = []
    for number, distance_cm in enumerate(distances_cm, start=1):
        while True:
            answer = ask(
                f"{number} of {len(distances_cm)}: hold {marker} {distance_cm:g} cm before the first camera, along "
                "its view; Enter when it is still, s to leave this one out"
            )
            if answer.strip().lower() == "s":
                break
            heard = asyncio.run(listen(bus, hold_s, lambda _: None))
            try:
                row = row_at(
                    0.01 * distance_cm, disparities(rig, heard.frames, marker)[1], ruler_m, calibration_px(rig)
                )
            except ConfigError as error:
                console.print(f"{error}; try again", style="yellow")
                continue
            rows.append(row)
            console.print(f"   disparity {row.disparity_px.value:.1f} ± {row.disparity_px.half_width:.1f} px")
            break
    return rows


def depth_rows(
    rig: Rig,
    bus: BusConfig,
    heard: Heard,
    marker: str,
    distances_cm: Sequence[float],
    ruler_m: float,
    console: Console,
) -> list[DepthRow]:
    """Return the rows of the depth table: by the truth of a simulated rig that was heard, or else by a session.

    Raises:
        ConfigError: the marker was seen at too few distances.
    """
    if heard.truth:
        rows = rows_by_truth(rig, heard.frames, heard.truth, marker)
    else:
        rows = depth_session(rig, bus, marker, distances_cm, ruler_m, console)
    if len(rows) < LEAST_ROWS:
        raise ConfigError(
            f"both cameras saw {marker} at {len(rows)} distances only, {LEAST_ROWS} are the least; is it in both "
            "pictures, and do the cameras keep up (`rhot status`)?"
        )
    return rows


async def pictures_of(bus_config: BusConfig, cameras: Sequence[str], count: int) -> dict[str, list[ImageArray]]:
    """Return some pictures of each running camera, bit by bit as they are."""
    found: dict[str, list[ImageArray]] = {name: [] for name in cameras}
    async with await Bus.open(bus_config, timeout_s=_CONNECT_S) as bus:
        for _ in range(count):
            for name in cameras:
                replies = await bus.get(f"rhot/preview/{name}?format=png", timeout_s=_ANSWER_S)
                found[name].append(np.ascontiguousarray(decoded(name, replies)))
            spacing_s = 0.1
            await asyncio.sleep(spacing_s)
    return found
