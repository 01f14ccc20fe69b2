"""The rig clock over the bus: the owner answers `rhot/clock`, everybody else asks it."""

from __future__ import annotations

import asyncio
import time
import uuid
from typing import Final

from rhot.bus import Answer, Bus, Request, message_answer
from rhot.clock import Exchange, NodeClock, SyncedRigClock
from rhot.errors import WireError
from rhot.messages import ClockReply, decode

CLOCK_KEY: Final = "rhot/clock"
_FIRST_INTERVAL_S: Final = 0.05
_FIRST_EXCHANGES: Final = 10
_READY_EXCHANGES: Final = 4
_INTERVAL_S: Final = 0.5
_TIMEOUT_S: Final = 1.0


def serve_clock(bus: Bus) -> None:
    """Answer `rhot/clock` with this machine's system time."""
    instance = uuid.uuid4().hex[:12]

    def answer(request: Request) -> Answer:
        reply = ClockReply(t_ns=time.time_ns(), received_t_ns=request.arrived_ns, instance=instance)
        return message_answer(reply, request)

    bus.queryable(CLOCK_KEY, answer)


async def exchange_once(bus: Bus, node: NodeClock, timeout_s: float = _TIMEOUT_S) -> tuple[Exchange, str] | None:
    """Ask the rig clock once; None when nobody answered. The second value names the clock that did."""
    timed = await bus.ask(CLOCK_KEY, node.now_ns, timeout_s)
    if timed is None:
        return None
    payload, t0, t3 = timed
    try:
        reply = decode(payload, ClockReply)
    except WireError:
        return None
    return Exchange(t0, reply.received_t_ns, reply.t_ns, t3), reply.instance


async def keep_synced(bus: Bus, clock: SyncedRigClock, ready: asyncio.Event) -> None:
    """Keep a node's idea of rig time fresh, for ever: quickly at first, then twice a second.

    `ready` is set once rig time is known well enough to stamp samples with it.
    """
    owner = ""
    done = 0
    while True:
        answered = await exchange_once(bus, clock.node)
        if answered is not None:
            exchange, instance = answered
            if instance != owner:
                if owner:
                    clock.estimator.reset()
                owner, done = instance, 0
            clock.estimator.add(exchange)
            done += 1
            if done >= _READY_EXCHANGES:
                ready.set()
        quick = done < _FIRST_EXCHANGES
        await asyncio.sleep(_FIRST_INTERVAL_S if quick else _INTERVAL_S)
