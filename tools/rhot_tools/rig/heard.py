"""What a rig says for a while: from the running one, or from a recording."""

from __future__ import annotations

import asyncio
import time
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field
from typing import Final

import click
import numpy as np
from rich.console import Console

from rhot.arrays import ImageArray
from rhot.bus import CONNECT_S, Bus
from rhot.clock import difference_ns
from rhot.errors import BusError, ConfigError
from rhot.messages import Control, HandPose, MarkerFrame, Message, ObjectPose, PointSet, ServiceStatus, Truth
from rhot.operation.control import newest_control
from rhot.rig import BusConfig, Rig
from rhot_calibration.colors.learning import decoded
from rhot_calibration.depth.fit import LEAST_ROWS
from rhot_tools.operate.live_rig import measured_rig_clock
from rhot_tools.rig.depth import DepthRow, calibration_px, disparities, row_at, rows_by_truth

# A session with somebody at the rig: what to do is said, then it is listened.

_HOLD_S: Final = 3.0
_ANSWER_S: Final = 2.0


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
    async with await Bus.open(bus_config, timeout_s=CONNECT_S) as bus:
        for _ in range(count):
            for name in cameras:
                replies = await bus.get(f"rhot/preview/{name}?format=png", timeout_s=_ANSWER_S)
                found[name].append(np.ascontiguousarray(decoded(name, replies)))
            spacing_s = 0.1
            await asyncio.sleep(spacing_s)
    return found


_MODELS: Final[dict[str, type[Message]]] = {
    "rhot/markers/*": MarkerFrame,
    "rhot/points": PointSet,
    "rhot/hand/*": HandPose,
    "rhot/object/*": ObjectPose,
    "rhot/truth": Truth,
    "rhot/status/**": ServiceStatus,
}


@dataclass(slots=True)
class Heard:
    """Messages in order of arrival.

    Attributes:
        frames: of all cameras.
        arrived_ns: rig time at which each frame was here; empty for a recording.
        points, truth: as published; truth only by a simulated rig.
        poses: hands and objects with their keys.
        statuses: the newest of each service, by `service/instance`.
        clock_s: bound of the error of the arrivals: half the round trip to the rig clock.
        start_ns: rig time at which the session began, which is a simulated world's time 0; 0 = not known.
    """

    frames: list[MarkerFrame] = field(default_factory=list)
    arrived_ns: list[int] = field(default_factory=list)
    points: list[PointSet] = field(default_factory=list)
    truth: list[Truth] = field(default_factory=list)
    poses: list[tuple[str, Message]] = field(default_factory=list)
    statuses: dict[str, ServiceStatus] = field(default_factory=dict)
    clock_s: float = 0.0
    start_ns: int = 0

    def note(self, key: str, message: Message, arrived_ns: int | None = None) -> None:
        """Take one message."""
        if isinstance(message, Control):
            # What starts all services is sent before they start; the newest is that of the session.
            self.start_ns = message.start_t_ns if message.action == "start" else self.start_ns
        elif isinstance(message, MarkerFrame):
            self.frames.append(message)
            if arrived_ns is not None:
                self.arrived_ns.append(arrived_ns)
        elif isinstance(message, PointSet):
            self.points.append(message)
        elif isinstance(message, Truth):
            self.truth.append(message)
        elif isinstance(message, ServiceStatus):
            self.statuses[f"{message.service}/{message.instance}"] = message
        else:
            self.poses.append((key, message))

    @classmethod
    def of(cls, messages: Iterable[tuple[str, Message]]) -> Heard:
        """Return what messages say that nobody timed at their arrival."""
        heard = cls()
        for key, message in messages:
            heard.note(key, message)
        return heard


async def listen(bus_config: BusConfig, seconds: float, progress: Callable[[float], None]) -> Heard:
    """Return what the running rig publishes.

    Args:
        bus_config: how to reach it.
        seconds: how long to listen.
        progress: called with the seconds that have passed.

    Raises:
        BusError: no router, or no camera's markers came.
    """
    heard = Heard()
    async with await Bus.open(bus_config, timeout_s=CONNECT_S) as bus:
        now_ns, heard.clock_s = await measured_rig_clock(bus)
        control = await newest_control(bus)
        if control is not None:
            heard.note("", control)
        loop = asyncio.get_running_loop()
        begun = loop.time()

        async def follow(keys: str, model: type[Message]) -> None:
            async for sample, message in bus.events(keys).messages(model):
                # When it was here, and not when this reader came to it.
                arrived_ns = sample.arrived_ns + difference_ns(now_ns, time.monotonic_ns)
                progress(loop.time() - begun)
                heard.note(sample.key, message, arrived_ns)

        try:
            async with asyncio.timeout(seconds), asyncio.TaskGroup() as tasks:
                for keys, model in _MODELS.items():
                    tasks.create_task(follow(keys, model))
        except TimeoutError:
            pass
    if not heard.frames:
        raise BusError(
            f"no camera's markers came in {seconds:g} s; is the rig running and started (see `rhot status`)?"
        )
    return heard
