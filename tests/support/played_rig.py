"""A rig of real processes whose cameras are played, each behind a link of its own, that tests stop, kill and cut off.

The supervisor of `rhot up` starts processes again that end, half a second later as systemd does.
"""

from __future__ import annotations

import asyncio
import contextlib
import random
import signal
import time
from collections.abc import AsyncIterator
from dataclasses import dataclass, field
from pathlib import Path

from bad_link import Link, relay
from moved_clock import make_clock

from rhot.bus import Bus, EventSubscriber
from rhot.errors import WireError
from rhot.messages import HandPose, MarkerFrame, Message, PointSet, ServiceStatus, decode
from rhot.operation.control import broadcast
from rhot.operation.status import fetch_status
from rhot.operation.supervisor import Child, Supervisor
from rhot.rig import BusConfig
from rhot_bench.speed.played_camera import write_played_rig
from rhot_sim.running.processes import free_endpoint

PLAYER = "rhot_bench.speed.played_camera"
CAMERAS = ("left", "right")
SERVICES = ("capture left", "capture right", "fusion", "ik")
PROCESSES = ("router", *SERVICES)
STREAMS: dict[str, type[Message]] = {
    "rhot/markers/left": MarkerFrame,
    "rhot/markers/right": MarkerFrame,
    "rhot/points": PointSet,
    "rhot/hand/right": HandPose,
}
ON_BUS = {"capture/left", "capture/right", "fusion/main", "ik/main"}
HAND = "rhot/hand/right"
PATIENCE_S = 60.0


@dataclass(frozen=True, slots=True)
class Arrival:
    """One message at the reader; times are those of this machine's system clock.

    Attributes:
        at_s: when it arrived.
        age_s: how old it was.
        t_s: the moment it speaks of.
        good: a hand that is measured, anything else that holds something.
        seq: its number.
    """

    at_s: float
    age_s: float
    t_s: float
    good: bool
    seq: int


class Watch:
    """Notes what arrives of each stream, as a program that uses the hand would see it.

    Attributes:
        arrivals: by key, in order.
        rig_ahead_s: how far the rig clock is ahead of this machine's.
    """

    def __init__(self) -> None:
        self.rig_ahead_s = 0.0
        self.arrivals: dict[str, list[Arrival]] = {key: [] for key in STREAMS}

    async def follow(self, key: str, mailbox: EventSubscriber) -> None:
        async for sample in mailbox:
            try:
                message = decode(sample.payload, STREAMS[key])
            except WireError:
                continue
            at_ns = time.time_ns() - (time.monotonic_ns() - sample.arrived_ns)
            t_s = message.t_ns / 1e9 - self.rig_ahead_s
            good = message.state == "measured" if isinstance(message, HandPose) else True
            self.arrivals[key].append(Arrival(at_ns / 1e9, at_ns / 1e9 - t_s, t_s, good, message.seq))

    def since(self, key: str, at_s: float) -> list[Arrival]:
        """Return what arrived on a key after a moment."""
        found = self.arrivals[key]
        first = len(found)
        while first and found[first - 1].at_s > at_s:
            first -= 1
        return found[first:]

    async def until_back(self, since_s: float) -> float:
        """Wait until both cameras and the measured hand tell of moments after `since_s`; return when they did."""
        async with asyncio.timeout(PATIENCE_S):
            while True:
                firsts = [self._first_fresh(key, since_s) for key in ("rhot/markers/left", "rhot/markers/right", HAND)]
                if all(first is not None for first in firsts):
                    return max(first for first in firsts if first is not None)
                await asyncio.sleep(0.01)

    def _first_fresh(self, key: str, since_s: float) -> float | None:
        fresh = [one for one in self.since(key, since_s) if one.t_s > since_s and one.good]
        return fresh[0].at_s if fresh else None


@dataclass(slots=True)
class PlayedRig:
    """The running rig.

    Attributes:
        folder: of the rig.
        endpoint: of the router.
        links: by service, between it and the router.
        endpoints: the other ends of the links.
        watch: what its reader saw.
        bus: of the reader, not over any link.
    """

    folder: Path
    endpoint: str
    supervisor: Supervisor
    links: dict[str, Link] = field(default_factory=dict)
    endpoints: dict[str, str] = field(default_factory=dict)
    watch: Watch = field(default_factory=Watch)
    clock_offsets: dict[str, tuple[float, float]] = field(default_factory=dict)
    _bus: Bus | None = None

    @property
    def rig_clock(self) -> Path:
        """The file by which the system clock of fusion's machine is set; see `moved_clock`."""
        return self.folder / "clock"

    @property
    def bus(self) -> Bus:
        assert self._bus is not None
        return self._bus

    async def start(self, name: str) -> None:
        """Start a process."""
        kind, _, camera = name.partition(" ")
        rig = ["--rig", str(self.folder)]
        connect = [] if kind == "router" else ["--connect", self.endpoints[name]]
        if camera:
            offset_s, drift_ppm = self.clock_offsets.get(camera, (0.0, 0.0))
            arguments = ["--camera", camera, f"--offset={offset_s}", f"--drift={drift_ppm}", *rig, *connect]
            await self.supervisor.start(name, arguments, module=PLAYER)
        elif kind == "fusion":
            arguments = [str(self.rig_clock), kind, *rig, *connect]
            await self.supervisor.start(name, arguments, module="moved_clock")
        else:
            await self.supervisor.start(name, [kind, *rig, *connect])

    def child(self, name: str) -> Child:
        """Return a process as it runs now, or as it ended last."""
        return next(child for child in self.supervisor.children if child.name == name)

    def pids(self) -> dict[str, int]:
        """Return the process ids of all processes."""
        return {child.name: child.process.pid for child in self.supervisor.children}

    def signal(self, name: str, number: signal.Signals) -> None:
        self.child(name).process.send_signal(number)

    async def all_run(self, session: str) -> bool:
        """Whether all services say that they work on a session."""
        _, statuses = await fetch_status(self.bus, timeout_s=0.5)
        running = {name for name, status in statuses.items() if (status.state, status.session) == ("running", session)}
        return running >= ON_BUS

    async def status(self, name: str) -> ServiceStatus:
        _, statuses = await fetch_status(self.bus)
        return statuses[name]

    def logs(self) -> str:
        return "\n".join(f"{child.name}:\n{child.tail()}" for child in self.supervisor.children)


@contextlib.asynccontextmanager
async def played_rig(
    folder: Path, clock_offsets: dict[str, tuple[float, float]] | None = None, rate_hz: float = 60.0
) -> AsyncIterator[PlayedRig]:
    """Run a played rig, started and tracking; all of it ends with the block.

    Args:
        folder: for its files.
        clock_offsets: by camera, of its clock: seconds off, parts per million of drift.
        rate_hz: of the cameras.
    """
    # Below the ephemeral ports: while the router is away, a connection to one of those may take it as its own port.
    endpoint = free_endpoint(f"tcp/127.0.0.1:{random.randint(20_000, 32_000)}")
    write_played_rig(folder / "rig", endpoint, rate_hz)
    make_clock(folder / "rig" / "clock")
    rig = PlayedRig(folder / "rig", endpoint, Supervisor(folder), clock_offsets=clock_offsets or {})
    async with contextlib.AsyncExitStack() as stack:
        for index, name in enumerate(SERVICES):
            rig.links[name] = Link(seed=index)
            rig.endpoints[name] = await stack.enter_async_context(relay(endpoint, rig.links[name]))
        try:
            for name in PROCESSES:
                await rig.start(name)
            async with (
                _kept(rig.supervisor),
                await Bus.open(BusConfig(connect=(endpoint,)), timeout_s=PATIENCE_S) as bus,
            ):
                rig._bus = bus
                following = [asyncio.create_task(rig.watch.follow(key, bus.events(key))) for key in STREAMS]
                await _start_session(bus)
                await rig.watch.until_back(time.time())
                try:
                    yield rig
                finally:
                    for task in following:
                        task.cancel()
                    await asyncio.gather(*following, return_exceptions=True)
        finally:
            for child in rig.supervisor.children:
                with contextlib.suppress(ProcessLookupError):
                    child.process.send_signal(signal.SIGCONT)
            await rig.supervisor.stop()


@contextlib.asynccontextmanager
async def _kept(supervisor: Supervisor) -> AsyncIterator[None]:
    """Start processes again that end, as `rhot up` does."""
    keeping = asyncio.create_task(supervisor.keep_running())
    try:
        yield
    finally:
        keeping.cancel()
        await asyncio.gather(keeping, return_exceptions=True)


async def _start_session(bus: Bus) -> None:
    async with asyncio.timeout(PATIENCE_S):
        while not (await fetch_status(bus, timeout_s=0.5))[0] >= ON_BUS:
            await asyncio.sleep(0.05)
    await broadcast(bus, "start", "faults", 0.3, PATIENCE_S)
