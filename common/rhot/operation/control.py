"""Starting and stopping a running rig: the broadcast that all services follow."""

from __future__ import annotations

import asyncio
import contextlib
import time
from typing import Literal

from rhot.bus import Bus
from rhot.clock import Exchange, SyncedRigClock, SystemClock, difference_ns
from rhot.errors import BusError, WireError
from rhot.messages import Control, Event, decode
from rhot.service.clock_sync import exchange_once
from rhot.service.control import CONTROL_KEY


async def rig_now_ns(bus: Bus, wait_s: float) -> int:
    """Return rig time by asking its owner.

    Raises:
        BusError: nobody answers within `wait_s`.
    """
    best = await quickest_exchange(bus, wait_s)
    return SystemClock().now_ns() + best.offset_ns


async def quickest_exchange(bus: Bus, wait_s: float) -> Exchange:
    """Ask the owner of rig time a few times and return the exchange whose round trip was the shortest.

    Raises:
        BusError: nobody answers within `wait_s`.
    """
    return min(await _exchanges(bus, wait_s), key=lambda exchange: exchange.round_trip_ns)


async def _exchanges(bus: Bus, wait_s: float) -> list[Exchange]:
    clock = SystemClock()
    deadline = time.monotonic() + wait_s
    exchanges: list[Exchange] = []
    clock_tries = 5
    while len(exchanges) < clock_tries:
        answered = await exchange_once(bus, clock, timeout_s=0.5)
        if answered is not None:
            exchanges.append(answered[0])
        elif time.monotonic() >= deadline:
            raise BusError(
                "no service answers rhot/clock, so there is no rig time to start at; start fusion first "
                "(`rhot up`, `rhot fusion`, or systemctl start rhot.target), or wait for it with --wait SECONDS"
            )
        else:
            await asyncio.sleep(0.1)
    return exchanges


async def broadcast(bus: Bus, action: Literal["start", "stop"], session: str, delay_s: float, wait_s: float) -> Control:
    """Publish a control message and return it as sent.

    Raises:
        BusError: a start, and nobody owns the rig clock; a stop needs no clock.
    """
    try:
        now_ns = await rig_now_ns(bus, wait_s)
    except BusError:
        if action == "start":
            raise
        now_ns = time.time_ns()
    newest = await newest_control(bus)
    control = Control(
        t_ns=now_ns,
        action=action,
        session=session,
        start_t_ns=now_ns + round(delay_s * 1e9) if action == "start" else 0,
        # 0 stands for a sender that did not ask; services would count it as 1, and not be told from others.
        revision=1 if newest is None else newest.revision + 1,
    )
    publisher = bus.publisher(CONTROL_KEY, Control, reliable=True)
    await publisher.wait_for_reader(2.0)
    # Reliable: it waits where the network is full, so not on the event loop. Who takes a stop answers for it. One that
    # was refused, of another session, must not be learnt from its sender.
    return await asyncio.to_thread(publisher.put, control, answers=action == "start")


async def followers(bus: Bus, sent: Control, wait_s: float) -> int:
    """Return how many services follow a control message of `broadcast`; asks until one does or `wait_s` is over."""
    deadline = time.monotonic() + wait_s
    while True:
        count = -1 if sent.action == "start" else 0  # whoever sent a start knows it, too
        for reply in await bus.get(CONTROL_KEY, timeout_s=1.0):
            with contextlib.suppress(WireError):
                known = decode(reply.payload, Control)
                count += (known.action, known.session, known.revision) == (sent.action, sent.session, sent.revision)
        if count > 0 or time.monotonic() >= deadline:
            return max(count, 0)
        await asyncio.sleep(0.1)


async def newest_control(bus: Bus) -> Control | None:
    """Return the newest control message that any service knows; None when the rig was never started."""
    newest: Control | None = None
    for reply in await bus.get(CONTROL_KEY, timeout_s=1.0):
        with contextlib.suppress(WireError):
            control = decode(reply.payload, Control)
            if newest is None or (control.revision, control.t_ns) > (newest.revision, newest.t_ns):
                newest = control
    return newest


def new_session() -> str:
    """Return a name for a session that begins now."""
    return time.strftime("%Y%m%d-%H%M%S")


class EventPublisher:
    """Publishes moments that somebody marks, on `rhot/event`.

    What a mark learns of rig time serves the later ones: a machine that is busy for a moment puts none at a wrong time.

    Args:
        bus: of the rig.
    """

    def __init__(self, bus: Bus) -> None:
        self._bus = bus
        self._clock = SyncedRigClock(SystemClock())
        self._publisher = bus.publisher("rhot/event", Event)

    async def put(self, label: str, source: str, *, at_ns: int | None = None, late_s: float = 0.0) -> Event:
        """Publish that something happened, and return the message.

        Args:
            label: what happened.
            source: who says so.
            at_ns: when, by this machine's system clock (`time.time_ns`); now by default.
            late_s: by how much that may be too late.

        Raises:
            BusError: no service answers for rig time.
            ValidationError: the label is too long.
        """
        now_ns = self._clock.node.now_ns
        at_ns = now_ns() if at_ns is None else at_ns + difference_ns(now_ns, time.time_ns)
        for exchange in await _exchanges(self._bus, 2.0):
            self._clock.estimator.add(exchange)
        uncertainty_s = 1e-9 * self._clock.estimator.uncertainty_at(at_ns) + late_s
        event = Event(
            t_ns=self._clock.to_rig_ns(at_ns), label=label, source=source, uncertainty_s=round(uncertainty_s, 6)
        )
        self._publisher.put(event)
        return event
