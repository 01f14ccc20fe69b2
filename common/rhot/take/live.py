"""`rhot.connect`: a running rig for programs and notebooks, with `with` and `for` or their async forms."""

from __future__ import annotations

import asyncio
import os
import re
import threading
import time
from collections.abc import AsyncIterator, Awaitable, Callable, Iterator
from concurrent.futures import Future
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final, Generic, Self, TypeVar

import numpy as np
from pydantic import ValidationError

from rhot.anatomy.skeleton import HAND_ANGLE_NAMES, HAND_ANGLES, JOINTS
from rhot.arrays import FloatArray
from rhot.bus import CONNECT_S, Bus
from rhot.errors import BusError, ConfigError
from rhot.messages import Event, HandPose, Message, ObjectPose, PointSet, first_problem
from rhot.messages.base import NAME_PATTERN
from rhot.operation.control import EventPublisher
from rhot.recording.mcap.wire_models import model_of_key
from rhot.rig import BusConfig
from rhot.rig.folder import load_config
from rhot.take.tracks import landmarks21

T = TypeVar("T")
ENDPOINT = "tcp/127.0.0.1:7447"


@dataclass(frozen=True, slots=True, eq=False)
class HandSample:
    """A hand at one moment; arrays as in `HandTrack`, without the time axis.

    Attributes:
        side: `left` or `right`.
        t_ns: when it was true, nanoseconds since 1970 on the rig clock.
        positions: (26, 3) metres, NaN = none.
        orientations: (26, 4) unit quaternions x, y, z, w.
        sigma: (26,) metres; NaN where the rig states none.
        angles: (20,) radians, as `angle_names`.
        state: `measured` or `predicted`.
    """

    side: str
    t_ns: int
    positions: FloatArray
    orientations: FloatArray
    sigma: FloatArray
    angles: FloatArray
    state: str

    joint_names = JOINTS
    angle_names = HAND_ANGLE_NAMES

    def __repr__(self) -> str:
        return f"<HandSample {self.side}: {self.state} at {self.t_ns}>"

    @classmethod
    def of(cls, hand: HandPose) -> HandSample:
        """Return a message as arrays."""
        none = (np.nan,) * 4
        joints = [hand.joints.get(name) for name in JOINTS]
        angles = [(hand.angles.get(finger), name) for finger, name in HAND_ANGLES]
        return cls(
            side=hand.side,
            t_ns=hand.t_ns,
            positions=np.array([none[:3] if joint is None else joint.position for joint in joints]),
            orientations=np.array([none if joint is None else joint.orientation for joint in joints]),
            sigma=np.array([hand.sigma.get(name, np.nan) for name in JOINTS]),
            angles=np.array([np.nan if each is None else getattr(each, name) for each, name in angles]),
            state=hand.state,
        )

    def joint(self, name: str) -> FloatArray:
        """Return the position (3,) of one joint, metres."""
        return np.asarray(self.positions[JOINTS.index(name)])

    def landmarks21(self, order: str = "mediapipe", frame: str | None = None) -> FloatArray:
        """Return 21 points (21, 3), metres; arguments as of `HandTrack.landmarks21`."""
        return landmarks21(self.positions, self.orientations, order, frame)


class Stream(Generic[T]):
    """What arrives on a key, the newest of it; to be read with `for` or `async for`, as its rig was connected."""

    def __init__(self, rig: LiveRig, key: str, model: type[Message], made: Callable[[Any], T]) -> None:
        self._rig, self._key, self._model, self._made = rig, key, model, made

    async def __aiter__(self) -> AsyncIterator[T]:
        """Yield for ever."""
        bus = self._rig.bus
        mailbox = bus.latest(self._key)
        try:
            async for _, message in mailbox.messages(self._model):
                yield self._made(message)
        finally:
            await bus.unsubscribe(mailbox)

    def __iter__(self) -> Iterator[T]:
        """Yield for ever; Ctrl-C ends it."""
        values = aiter(self)
        try:
            while True:
                yield self._rig.wait(lambda: anext(values))
        finally:
            # A loop that was left early is collected at any time, also when all is closed already.
            if self._rig.is_open:
                self._rig.wait(values.aclose)  # type: ignore[attr-defined]


_CANCELLED_S: Final = 1.0
_NOT_OPEN: Final = "the rig is not connected; use `with rhot.connect() as rig:`"


class LiveRig:
    """A connection to a running rig: a context manager, sync or async."""

    def __init__(self, config: BusConfig, timeout_s: float) -> None:
        self._config, self._timeout_s = config, timeout_s
        self._bus: Bus | None = None
        self._events: EventPublisher | None = None
        self._loop: asyncio.AbstractEventLoop | None = None
        self._thread: threading.Thread | None = None

    @property
    def is_open(self) -> bool:
        """Whether it is connected."""
        return self._bus is not None

    @property
    def bus(self) -> Bus:
        """The connection itself, for everything else.

        Raises:
            BusError: it is not open.
        """
        if self._bus is None:
            raise BusError(_NOT_OPEN)
        return self._bus

    def hands(self, side: str) -> Stream[HandSample]:
        """Return the hands of one side, `left` or `right`, as they arrive; the newest where the reader is slower.

        Raises:
            ValueError: no such side.
        """
        if side not in ("left", "right"):
            raise ValueError(f"side {side!r}: choose left or right")
        return Stream(self, f"rhot/hand/{side}", HandPose, HandSample.of)

    def points(self) -> Stream[PointSet]:
        """Return the markers in space as they arrive."""
        return Stream(self, "rhot/points", PointSet, lambda points: points)

    def objects(self, name: str) -> Stream[ObjectPose]:
        """Return the poses of an object as they arrive.

        Raises:
            ValueError: no object can have that name.
        """
        if not re.fullmatch(NAME_PATTERN, name):
            raise ValueError(f"object {name!r}: one name, as in rig.toml")
        return Stream(self, f"rhot/object/{name}", ObjectPose, lambda pose: pose)

    def messages(self, key: str) -> Stream[Message]:
        """Return the messages of any key, such as `rhot/foot/left`, as they arrive.

        Raises:
            ConfigError: no messages of ours are on that key.
        """
        model = model_of_key(key)
        if model is None:
            raise ConfigError(f"{key}: no key with messages; docs/messages.md names them all")
        return Stream(self, key, model, lambda message: message)

    def mark(self, label: str, at_ns: int | None = None) -> Event:
        """Mark a moment for recordings, from a program without an event loop.

        With one: `await EventPublisher(rig.bus).put(label, "…")` of `rhot.operation.control`.

        Args:
            label: what happened.
            at_ns: when, by `time.time_ns`; now by default.

        Raises:
            BusError: no service answers for rig time.
            ValueError: the label is no text of at most 64 characters.
        """
        at_ns = time.time_ns() if at_ns is None else at_ns
        try:
            return self.wait(lambda: self._mark(label, at_ns))
        except ValidationError as error:
            raise ValueError(first_problem(error)) from None

    async def _mark(self, label: str, at_ns: int) -> Event:
        if self._events is None:
            self._events = EventPublisher(self.bus)
        return await self._events.put(label, "program", at_ns=at_ns)

    async def __aenter__(self) -> Self:
        """Connect.

        Raises:
            BusError: no router answers.
        """
        self._bus = await Bus.open(self._config, timeout_s=self._timeout_s)
        return self

    async def __aexit__(self, *_: object) -> None:
        """Disconnect."""
        bus, self._bus, self._events = self._bus, None, None
        if bus is not None:
            await bus.close()

    def wait(self, work: Callable[[], Awaitable[T]]) -> T:
        """Begin something on the connection's own thread, and return its result."""
        if self._loop is None:
            if not self.is_open:
                raise BusError(_NOT_OPEN)
            raise BusError("connected with `async with`: read with `async for`")

        ended = threading.Event()

        async def awaited() -> T:
            try:
                return await work()
            finally:
                ended.set()

        future: Future[T] = asyncio.run_coroutine_threadsafe(awaited(), self._loop)
        try:
            return future.result()
        except KeyboardInterrupt:
            # What nobody waits for any more must have ended before its stream can be closed.
            future.cancel()
            ended.wait(_CANCELLED_S)
            raise

    def __enter__(self) -> Self:
        """Connect, with a thread of its own that listens.

        Raises:
            BusError: no router answers.
        """
        self._loop = asyncio.new_event_loop()
        self._thread = threading.Thread(target=self._loop.run_forever, name="rhot-live", daemon=True)
        self._thread.start()
        try:
            return self.wait(self.__aenter__)
        except BaseException:
            self._end()
            raise

    def __exit__(self, *_: object) -> None:
        """Disconnect."""
        try:
            self.wait(self.__aexit__)
        finally:
            self._end()

    def _end(self) -> None:
        loop, self._loop = self._loop, None
        if loop is not None and self._thread is not None:
            asyncio.run_coroutine_threadsafe(loop.shutdown_asyncgens(), loop).result()
            loop.call_soon_threadsafe(loop.stop)
            self._thread.join()
            loop.close()


def connect(
    endpoint: str | None = None, *, rig: str | Path | None = None, namespace: str = "", timeout_s: float = CONNECT_S
) -> LiveRig:
    """Return a connection to a running rig, to be opened with `with` or `async with`.

    Args:
        endpoint: of the rig's router; else RHOT_CONNECT, else what the rig folder says, else this machine.
        rig: rig folder, for its address and certificates.
        namespace: of the rig.
        timeout_s: how long to wait for the router.

    Raises:
        ConfigError: the rig folder is not valid.
    """
    config = BusConfig(connect=(ENDPOINT,)) if rig is None else load_config(Path(rig)).bus
    endpoint = endpoint or os.environ.get("RHOT_CONNECT")
    changes: dict[str, Any] = {"mode": "client", "listen": ()}
    changes |= {"connect": (endpoint,)} if endpoint else {}
    changes |= {"namespace": namespace} if namespace else {}
    return LiveRig(config.model_copy(update=changes), timeout_s)
