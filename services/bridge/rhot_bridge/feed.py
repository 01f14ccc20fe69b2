"""Subscribes to the bus and decodes messages once for all bridges of a process."""

from __future__ import annotations

import asyncio
import contextlib
import logging
from collections.abc import Mapping
from typing import Final, Protocol

import numpy as np
from pydantic import TypeAdapter, ValidationError

from rhot.arrays import FloatArray
from rhot.bus import LatestSubscriber
from rhot.errors import BusError, WireError
from rhot.messages import BodyPose, FootPose, HandPose, HeadPose, Name, ObjectPose, Space, decode
from rhot.service import Node
from rhot_bridge.axes import Converter
from rhot_bridge.scene import Axes, Tracked, tracked

logger = logging.getLogger(__name__)


STAGE_KEY: Final = "rhot/space/stage"
_STAGE_RETRY_S: Final = 1.0
_OTHER_HAND_S: Final = 0.002
"""Longest wait for the other hand of a sample: ik publishes both hands one right after the other."""

_KEYS: Final = ("rhot/hand/*", "rhot/object/*", "rhot/head", "rhot/foot/*", "rhot/body")
_MODELS: Final[Mapping[str, type[HandPose | ObjectPose | FootPose | BodyPose]]] = {
    "hand": HandPose,
    "object": ObjectPose,
    "head": HeadPose,
    "foot": FootPose,
    "body": BodyPose,
}
"""Model of the messages on these keys by the kind, which is the second chunk of the key."""
_NAME: Final = TypeAdapter(Name)


class Listener(Protocol):
    """A user of the feed: a bridge."""

    def add_sample(self, key: str, tracked: Tracked, arrived_ns: int) -> None:
        """Store a sample; `arrived_ns` is on the clock of `time.monotonic_ns`."""
        ...

    def update_complete(self, kind: str, arrived_ns: int) -> None:
        """Send if due: all samples of a kind (`hand`, `foot`, …) with the same time have been added."""
        ...

    def stage_changed(self) -> None:
        """Replace the converter: the stage has become known, or has changed."""
        ...


class HandPairing:
    """Detects when both hands of a sample have arrived; reads no clock.

    Hands that are solved together carry the same time. If both had the same time last time, the first hand of a sample
    waits for the other.
    """

    def __init__(self) -> None:
        self._stamps: dict[str, int] = {}
        self._together = False

    def add(self, key: str, t_ns: int) -> bool:
        """Add a hand's time `t_ns`; return whether the sample is complete."""
        self._stamps[key] = t_ns
        others = [stamp for other, stamp in self._stamps.items() if other != key]
        if t_ns in others:
            self._together = True
            return True
        return not self._together

    def time_out(self) -> None:
        """Stop waiting for the other hand until both have the same time again."""
        self._together = False


class Feed:
    """Subscribes on the bus of the first attached bridge, and passes the samples to all bridges."""

    def __init__(self) -> None:
        self._node: asyncio.Future[Node] = asyncio.get_running_loop().create_future()
        self._listeners: list[Listener] = []
        self._pairing = HandPairing()
        self._late: asyncio.TimerHandle | None = None
        self._first_ns = 0
        self._T_rig_stage: FloatArray | None = None
        self._converters: dict[Axes, Converter] = {"rig": Converter("rig")}

    def converter(self, axes: Axes) -> Converter | None:
        """Return the shared converter to some axes; None while the stage is unknown."""
        if axes not in self._converters and self._T_rig_stage is not None:
            self._converters[axes] = Converter(axes, self._T_rig_stage)
        return self._converters.get(axes)

    def attach(self, node: Node, listener: Listener) -> None:
        """Add a bridge."""
        self._listeners.append(listener)
        if not self._node.done():
            self._node.set_result(node)

    async def run(self) -> None:
        """Pass samples on until the bus is closed."""
        node = await self._node
        poses, stages = node.bus.latest(*_KEYS), node.bus.latest(STAGE_KEY)
        async with asyncio.TaskGroup() as tasks:
            tasks.create_task(self._follow(node, poses))
            tasks.create_task(self._follow_stage(node, stages))
            tasks.create_task(self._ask_for_stage(node))

    async def _follow(self, node: Node, mailbox: LatestSubscriber) -> None:
        async for sample in mailbox:
            kind = sample.key.split("/", 2)[1]
            message = node.read(sample, _MODELS[kind])
            if message is None:
                continue
            try:
                _check_key(sample.key, message)
                found = tracked(message)
            except WireError as error:
                node.refuse(sample.key, error)
                continue
            mailbox.keep_slot_of(sample.key)
            node.status.tick("input")
            for listener in self._listeners:
                listener.add_sample(sample.key, found, sample.arrived_ns)
            self._announce(kind, sample.key, found.t_ns, sample.arrived_ns)

    def _announce(self, kind: str, key: str, t_ns: int, arrived_ns: int) -> None:
        if kind == "hand":
            if not self._pairing.add(key, t_ns):
                if self._late is None:
                    self._first_ns = arrived_ns
                    self._late = asyncio.get_running_loop().call_later(_OTHER_HAND_S, self._hand_alone)
                return
            if self._late is not None:
                # The sample is as old as its first hand.
                arrived_ns = self._first_ns
                self._late.cancel()
                self._late = None
        for listener in self._listeners:
            listener.update_complete(kind, arrived_ns)

    def _hand_alone(self) -> None:
        self._late = None
        self._pairing.time_out()
        for listener in self._listeners:
            listener.update_complete("hand", self._first_ns)

    async def _follow_stage(self, node: Node, mailbox: LatestSubscriber) -> None:
        async for sample in mailbox:
            if not sample.deleted:
                self._take_stage(node, sample.payload)

    async def _ask_for_stage(self, node: Node) -> None:
        """Query the stage, which may have been published before this process started."""
        while self._T_rig_stage is None:
            with contextlib.suppress(BusError):
                for reply in await node.bus.get(STAGE_KEY, timeout_s=_STAGE_RETRY_S):
                    if not reply.error:
                        self._take_stage(node, reply.payload)
            await asyncio.sleep(_STAGE_RETRY_S)

    def _take_stage(self, node: Node, payload: bytes) -> None:
        try:
            space = decode(payload, Space)
        except WireError as error:
            node.refuse(STAGE_KEY, error)
            return
        T_rig_stage = np.array(space.T_rig_space)
        if self._T_rig_stage is not None and np.array_equal(T_rig_stage, self._T_rig_stage):
            return
        if self._T_rig_stage is None:
            logger.info("the floor is known, by %s", space.source)
        self._T_rig_stage = T_rig_stage
        self._converters = {"rig": self._converters["rig"]}
        for listener in self._listeners:
            listener.stage_changed()


def _check_key(key: str, message: HandPose | ObjectPose | FootPose | BodyPose) -> None:
    """Refuse a message on a wrong key, because names are passed on to other programs.

    Raises:
        WireError: the key names the other side or no side, or the object's name is not valid.
    """
    _, kind, *rest = key.split("/")
    if isinstance(message, HandPose | FootPose):
        if rest != [message.side]:
            raise WireError(f"the message belongs on rhot/{kind}/{message.side}")
    elif rest:
        try:
            _NAME.validate_python(rest[0])
        except ValidationError as error:
            raise WireError("not the name of an object: letters, digits, _, . and -, 64 at most") from error
