"""Keeping what a running rig publishes, with its age on arrival, for later comparison.

Only what the comparison needs is kept, so that an hour of poses fits into memory.
"""

from __future__ import annotations

import asyncio
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from rhot.anatomy.skeleton import FINGERS, JOINTS
from rhot.bus import Bus, EventSubscriber
from rhot.clock import difference_ns
from rhot.errors import WireError
from rhot.messages import HandPose, Message, ObjectPose, PointSet, Position, Quaternion, Side, decode

M = TypeVar("M", bound=Message)


@dataclass(frozen=True, slots=True)
class HandSample:
    """One hand as it arrived.

    Attributes:
        t_ns: when it was true, rig clock.
        age_s: from then to its arrival here.
        side: whose hand.
        positions: (26, 3) float32 metres, rig frame, in the order of `rhot.anatomy.skeleton.JOINTS`; NaN = no such
        joint. measured: (5,) which fingers were measured.
    """

    t_ns: int
    age_s: float
    side: Side
    positions: NDArray[np.float32]
    measured: tuple[bool, ...]


@dataclass(frozen=True, slots=True)
class PointsSample:
    """One point set as it arrived.

    Attributes:
        t_ns: when it was true, rig clock.
        age_s: from then to its arrival here.
        measured: measured points, metres, rig frame.
        predicted: names of the points that were only predicted.
    """

    t_ns: int
    age_s: float
    measured: dict[str, Position]
    predicted: tuple[str, ...]


@dataclass(frozen=True, slots=True)
class ObjectSample:
    """One object as it arrived.

    Attributes:
        t_ns: when it was true, rig clock.
        age_s: from then to its arrival here.
        position, orientation: metres, rig frame; unit quaternion x, y, z, w.
        measured: whether it was.
    """

    t_ns: int
    age_s: float
    position: Position
    orientation: Quaternion
    measured: bool


@dataclass(slots=True)
class Collected:
    """Everything of one run, in order of arrival.

    Attributes:
        hands, objects: by side and by object id.
        points: point sets.
        invalid: messages that were none.
    """

    hands: dict[str, list[HandSample]] = field(default_factory=dict)
    objects: dict[str, list[ObjectSample]] = field(default_factory=dict)
    points: list[PointsSample] = field(default_factory=list)
    invalid: int = 0

    def clear(self) -> None:
        """Forget all, as at a session's start."""
        self.hands.clear()
        self.objects.clear()
        self.points.clear()
        self.invalid = 0


def hand_sample(pose: HandPose, age_s: float) -> HandSample:
    """Return what is kept of a hand pose."""
    nowhere = (np.nan, np.nan, np.nan)
    positions = [pose.joints[name].position if name in pose.joints else nowhere for name in JOINTS]
    measured = tuple(pose.fingers.get(finger) == "measured" for finger in FINGERS)
    return HandSample(pose.t_ns, age_s, pose.side, np.array(positions, dtype=np.float32), measured)


def points_sample(points: PointSet, age_s: float) -> PointsSample:
    """Return what is kept of a point set."""
    measured = {name: point.position for name, point in points.points.items() if point.state == "measured"}
    return PointsSample(points.t_ns, age_s, measured, tuple(name for name in points.points if name not in measured))


def object_sample(pose: ObjectPose, age_s: float) -> ObjectSample:
    """Return what is kept of an object's pose."""
    return ObjectSample(pose.t_ns, age_s, pose.position, pose.orientation, pose.state == "measured")


async def follow(
    mailbox: EventSubscriber,
    model: type[M],
    rig_now_ns: Callable[[], int],
    keep: Callable[[str, M, float], None],
    refuse: Callable[[], None],
) -> None:
    """Read messages until cancelled.

    Args:
        mailbox: where they arrive.
        model: of all of them.
        rig_now_ns: reads the rig clock.
        keep: takes the last part of the key, the message, and its age in seconds when it arrived.
        refuse: called for what is no such message.
    """
    async for sample in mailbox:
        # Counted to the arrival, not to the moment at which this busy process found time to look.
        arrived_t_ns = sample.arrived_ns + difference_ns(rig_now_ns, time.monotonic_ns)
        try:
            message = decode(sample.payload, model)
        except WireError:
            refuse()
            continue
        keep(sample.key.rpartition("/")[2], message, (arrived_t_ns - message.t_ns) / 1e9)


async def collect(bus: Bus, into: Collected, rig_now_ns: Callable[[], int]) -> None:
    """Collect hands, points and objects until cancelled.

    Args:
        bus: the session.
        into: grows while this runs.
        rig_now_ns: reads the rig clock.
    """

    def refuse() -> None:
        into.invalid += 1

    def keep_points(_: str, points: PointSet, age_s: float) -> None:
        into.points.append(points_sample(points, age_s))

    def keep_hand(side: str, pose: HandPose, age_s: float) -> None:
        into.hands.setdefault(side, []).append(hand_sample(pose, age_s))

    def keep_object(name: str, pose: ObjectPose, age_s: float) -> None:
        into.objects.setdefault(name, []).append(object_sample(pose, age_s))

    async with asyncio.TaskGroup() as tasks:
        tasks.create_task(follow(bus.events("rhot/points"), PointSet, rig_now_ns, keep_points, refuse))
        tasks.create_task(follow(bus.events("rhot/hand/*"), HandPose, rig_now_ns, keep_hand, refuse))
        tasks.create_task(follow(bus.events("rhot/object/*"), ObjectPose, rig_now_ns, keep_object, refuse))
