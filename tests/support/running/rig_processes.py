"""Services as real processes that tests can start, kill and wait for."""

from __future__ import annotations

import asyncio
import contextlib
import os
import time
from collections.abc import Callable, Iterator
from pathlib import Path

from bus_watch import PATIENCE_S

from rhot.bus import Bus
from rhot.errors import WireError
from rhot.messages import Control, HandPose, MarkerFrame, Message, decode
from rhot.operation.control import broadcast
from rhot.operation.supervisor import Child, Supervisor

SERVICES = {
    "router": ["router"],
    "capture left": ["capture", "--camera", "left"],
    "capture right": ["capture", "--camera", "right"],
    "fusion": ["fusion"],
    "ik": ["ik"],
    "objects": ["objects"],
    "truth": ["truth"],
}


class Processes:
    """Services as processes that can be started, killed and started again one by one."""

    def __init__(self, rig: Path, logs: Path) -> None:
        self.rig = rig
        self.supervisor = Supervisor(logs)
        self.running: dict[str, Child] = {}

    async def start(self, name: str) -> None:
        self.running[name] = await self.supervisor.start(name, [*SERVICES[name], "--rig", str(self.rig)])

    async def kill(self, name: str) -> None:
        child = self.running.pop(name)
        child.process.kill()
        await child.process.wait()

    def logs(self) -> str:
        return "\n".join(f"{name}:\n{child.tail()}" for name, child in self.running.items())


async def next_message(bus: Bus, key: str, model: type[Message], wanted: Callable[[Message], bool]) -> Message:
    """Return the first message on a key that is wanted."""
    async with asyncio.timeout(PATIENCE_S):
        async for sample in bus.latest(key):
            with contextlib.suppress(WireError):
                message = decode(sample.payload, model)
                if wanted(message):
                    return message
    raise AssertionError(f"the subscription of {key} ended")


async def hand_measured_after(bus: Bus, t_ns: int) -> float:
    """Wait for a hand that both cameras and all services measured after a moment; return the seconds it took."""
    begun = time.monotonic()

    def fresh(message: Message) -> bool:
        return message.t_ns > t_ns

    def complete(message: Message) -> bool:
        assert isinstance(message, HandPose)
        return fresh(message) and message.state == "measured" and "predicted" not in message.fingers.values()

    await asyncio.gather(
        next_message(bus, "rhot/markers/left", MarkerFrame, fresh),
        next_message(bus, "rhot/markers/right", MarkerFrame, fresh),
        next_message(bus, "rhot/hand/right", HandPose, complete),
    )
    return time.monotonic() - begun


async def start_rig(bus: Bus, wait_s: float = 15.0) -> Control:
    """Broadcast start."""
    return await broadcast(bus, "start", "test", 0.3, wait_s)


def processes_that_name(text: str) -> Iterator[str]:
    """Yield command lines of running processes, other than this one, that hold a text."""
    for entry in Path("/proc").iterdir():
        if entry.name.isdigit() and int(entry.name) != os.getpid():
            with contextlib.suppress(OSError):
                line = (entry / "cmdline").read_bytes().replace(b"\0", b" ").decode(errors="replace")
                if text in line:
                    yield line
