"""A router and a rig that publishes a moving right hand and its points, for readers of either kind."""

from __future__ import annotations

import asyncio
import itertools
import threading
from collections.abc import Iterator
from contextlib import contextmanager

from hand_messages import hand_pose, point_set

from rhot.bus import Bus
from rhot.messages import HandPose, PointSet
from rhot.rig import BusConfig

START_NS = 1_790_000_000_000_000_000


async def publish(config: BusConfig, stop: threading.Event | asyncio.Event) -> None:
    async with await Bus.open(config) as bus:
        hands, points = bus.publisher("rhot/hand/right", HandPose), bus.publisher("rhot/points", PointSet)
        for index in itertools.count():
            if stop.is_set():
                return
            hands.put(hand_pose(0.01 * index, START_NS + index * 10_000_000))
            points.put(point_set(START_NS + index * 10_000_000))
            await asyncio.sleep(0.01)


@contextmanager
def publishing(endpoint: str) -> Iterator[None]:
    """A router and a rig in a thread of their own, for readers that know no event loop."""
    stop, listening = threading.Event(), threading.Event()

    async def run() -> None:
        async with await Bus.open(BusConfig(mode="router", connect=(), listen=(endpoint,))):
            listening.set()
            await publish(BusConfig(connect=(endpoint,)), stop)

    thread = threading.Thread(target=asyncio.run, args=(run(),))
    thread.start()
    listening.wait(10.0)
    try:
        yield
    finally:
        stop.set()
        thread.join()
