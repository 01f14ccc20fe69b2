"""Keeping what a running rig publishes, with its age on arrival, for later comparison."""

from __future__ import annotations

import asyncio
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Generic, TypeVar

from rhot.bus import Bus, EventSubscriber
from rhot.errors import WireError
from rhot.messages import HandPose, Message, ObjectPose, PointSet, decode

M = TypeVar("M", bound=Message)


@dataclass(frozen=True, slots=True)
class Arrival(Generic[M]):
    """One received message.

    Attributes:
        message: as published.
        age_s: from the moment it was true (mid-exposure) to its arrival here, seconds.
    """

    message: M
    age_s: float


@dataclass(slots=True)
class Collected:
    """Everything of one run.

    Attributes:
        hands, objects: by side and by object id.
        points: point sets.
        invalid: messages that were none.
    """

    hands: dict[str, list[Arrival[HandPose]]] = field(default_factory=dict)
    objects: dict[str, list[Arrival[ObjectPose]]] = field(default_factory=dict)
    points: list[Arrival[PointSet]] = field(default_factory=list)
    invalid: int = 0


async def collect(bus: Bus, into: Collected, rig_now_ns: Callable[[], int]) -> None:
    """Collect hands, points and objects until cancelled.

    Args:
        bus: the session.
        into: grows while this runs.
        rig_now_ns: reads the rig clock.
    """

    async def follow(mailbox: EventSubscriber, model: type[M], keep: Callable[[str, Arrival[M]], None]) -> None:
        async for sample in mailbox:
            # Counted to the arrival, not to the moment at which this busy process found time to look.
            arrived_t_ns = rig_now_ns() - (time.monotonic_ns() - sample.arrived_ns)
            try:
                message = decode(sample.payload, model)
            except WireError:
                into.invalid += 1
                continue
            keep(sample.key.rpartition("/")[2], Arrival(message, (arrived_t_ns - message.t_ns) / 1e9))

    def keep_points(_: str, arrival: Arrival[PointSet]) -> None:
        into.points.append(arrival)

    def keep_hand(side: str, arrival: Arrival[HandPose]) -> None:
        into.hands.setdefault(side, []).append(arrival)

    def keep_object(name: str, arrival: Arrival[ObjectPose]) -> None:
        into.objects.setdefault(name, []).append(arrival)

    async with asyncio.TaskGroup() as tasks:
        tasks.create_task(follow(bus.events("rhot/points"), PointSet, keep_points))
        tasks.create_task(follow(bus.events("rhot/hand/*"), HandPose, keep_hand))
        tasks.create_task(follow(bus.events("rhot/object/*"), ObjectPose, keep_object))
