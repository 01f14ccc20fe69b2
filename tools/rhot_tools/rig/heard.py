"""What a rig says for a while: from the running one, or from a recording."""

from __future__ import annotations

import asyncio
import time
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from typing import Final

from rhot.bus import Bus
from rhot.errors import BusError
from rhot.messages import Control, HandPose, MarkerFrame, Message, ObjectPose, PointSet, ServiceStatus, Truth
from rhot.operation.control import newest_control
from rhot.rig import BusConfig
from rhot_tools.operate.live_rig import measured_rig_clock

_CONNECT_S: Final = 5.0
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
    async with await Bus.open(bus_config, timeout_s=_CONNECT_S) as bus:
        now_ns, heard.clock_s = await measured_rig_clock(bus)
        control = await newest_control(bus)
        if control is not None:
            heard.note("", control)
        loop = asyncio.get_running_loop()
        begun = loop.time()

        async def follow(keys: str, model: type[Message]) -> None:
            async for sample, message in bus.events(keys).messages(model):
                # When it was here, and not when this reader came to it.
                arrived_ns = now_ns() - (time.monotonic_ns() - sample.arrived_ns)
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
