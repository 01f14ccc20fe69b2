"""A service that puts each marker into space, run beside a test, and what is asked of it."""

from __future__ import annotations

import asyncio
import time
from collections.abc import AsyncIterator, Mapping
from contextlib import asynccontextmanager

from rhot.bus import Bus
from rhot.clock import SystemClock
from rhot.core import Output
from rhot.errors import ConfigError
from rhot.messages import Control, Marker, MarkerFrame, Point, PointSet, ServiceStatus, decode
from rhot.rig import BusConfig, FusionConfig
from rhot.service import CoreService
from rhot.service.runner import serve

LIMIT_S = 60.0


class Doubler:
    """A core that puts each marker into space, and can be told to fail."""

    def __init__(self, config: FusionConfig) -> None:
        self.config = config
        self.counts = {"fed": 0}

    figures: Mapping[str, float] = {"epipolar_px": 0.5}
    problem = ""

    def configure(self, config: FusionConfig) -> None:
        if config.hold_s > 10:
            raise ConfigError("hold_s over 10 s")
        self.config = config

    def feed(self, message: MarkerFrame) -> list[Output]:
        self.counts["fed"] += 1
        if "toe" in message.markers:
            raise ValueError("no toes here")
        points = {
            name: Point(position=(marker.u, marker.v, self.config.hold_s), sigma=0.0, views=1, state="measured")
            for name, marker in message.markers.items()
        }
        return [("rhot/points", PointSet(t_ns=message.t_ns, frame="rig", points=points))]


Doubling = CoreService[MarkerFrame, FusionConfig]


def doubler(*, owns_clock: bool = True, name: str = "fusion", kind: type[Doubling] = Doubling) -> Doubling:
    return kind(
        name,
        input_keys="rhot/markers/*",
        model=MarkerFrame,
        key_of=lambda frame: f"rhot/markers/{frame.camera}",
        config=FusionConfig(),
        make_core=Doubler,
        owns_clock=owns_clock,
    )


def frame(t_ns: int, camera: str = "left") -> MarkerFrame:
    marker = Marker(u=1.0, v=2.0, area=3.0, score=0.5)
    return MarkerFrame(t_ns=t_ns, camera=camera, width=640, height=480, markers={"thumb": marker})


@asynccontextmanager
async def running(service: CoreService[MarkerFrame, FusionConfig], bus: BusConfig) -> AsyncIterator[None]:
    """Run a service beside the test; ends it as a signal would."""
    task = asyncio.create_task(serve(service, bus, SystemClock()))
    try:
        yield
    finally:
        task.cancel()
        await asyncio.gather(task, return_exceptions=True)


async def start(bus: Bus, session: str = "s1", delay_s: float = 0.0) -> Control:
    now_ns = time.time_ns()
    publisher = bus.publisher("rhot/control", Control, reliable=True)
    assert await publisher.wait_for_reader(LIMIT_S)
    return publisher.put(
        Control(t_ns=now_ns, action="start", session=session, start_t_ns=now_ns + round(delay_s * 1e9))
    )


async def points_follow(bus: Bus) -> PointSet:
    """Publish markers until a point set comes back."""
    mailbox = bus.latest("rhot/points")
    publisher = bus.publisher("rhot/markers/left", MarkerFrame)
    reading = asyncio.create_task(mailbox.next())
    async with asyncio.timeout(LIMIT_S):
        while not reading.done():
            publisher.put(frame(time.time_ns()))
            await asyncio.wait((reading,), timeout=0.02)
    return decode((await reading).payload, PointSet)


def has_refused(number: int, status: ServiceStatus) -> bool:
    return status.counts.get("invalid", 0) >= number
