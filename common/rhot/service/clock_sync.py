"""The rig clock over the bus: the owner answers `rhot/clock`, everybody else asks it.

A rig has one clock. Where two answer (two fusions run), everybody stays with the one they know for as long as it
answers, and says so; else rig time would jump between the two.
"""

from __future__ import annotations

import asyncio
import time
import uuid
from dataclasses import dataclass
from typing import Final

from rhot.bus import Answer, Bus, Request, message_answer
from rhot.clock import Exchange, NodeClock, SyncedRigClock
from rhot.errors import WireError
from rhot.messages import ClockReply, decode

CLOCK_KEY: Final = "rhot/clock"
_FIRST_INTERVAL_S: Final = 0.05
_FIRST_EXCHANGES: Final = 10
"""A node that joins asks so many times, so quickly: it knows rig time within half a second. Chosen."""
_INTERVAL_S: Final = 0.5
"""Afterwards; the window of `rhot.clock.WINDOW` exchanges is a minute."""
_TIMEOUT_S: Final = 1.0
"""An answer that takes longer says nothing about the clock."""
_EARLIEST_NS: Final = 86_400_000_000_000
_LATEST_NS: Final = 4_102_444_800_000_000_000
"""Rig time lies between 2 January 1970, where a machine without a battery starts, and the year 2100: times beyond would
not fit into messages, or soon not."""


@dataclass(slots=True)
class ClockWatch:
    """What is wrong with the rig clock, for the status.

    Attributes:
        rivals: clocks that answer beside the one that is followed, or beside our own.
    """

    rivals: int = 0

    @property
    def problem(self) -> str:
        """One sentence, empty when all is well."""
        if not self.rivals:
            return ""
        return f"{self.rivals + 1} processes answer {CLOCK_KEY}: a second fusion runs on this bus; stop one of them"


@dataclass(frozen=True, slots=True)
class ClockAnswer:
    """One exchange, and which clock answered."""

    exchange: Exchange
    instance: str


def serve_clock(bus: Bus) -> str:
    """Answer `rhot/clock` with this machine's system time; return the name by which this clock is known."""
    instance = uuid.uuid4().hex[:12]

    def answer(request: Request) -> Answer:
        reply = ClockReply(t_ns=time.time_ns(), received_t_ns=request.arrived_ns, instance=instance)
        return message_answer(reply, request)

    bus.queryable(CLOCK_KEY, answer)
    return instance


async def exchange_with_all(bus: Bus, node: NodeClock, timeout_s: float = _TIMEOUT_S) -> list[ClockAnswer]:
    """Ask the rig clock once; return the exchanges with all that answered, none that cannot be true among them."""
    found: list[ClockAnswer] = []
    for timed in await bus.ask(CLOCK_KEY, node.now_ns, timeout_s):
        try:
            reply = decode(timed.payload, ClockReply)
        except WireError:
            continue
        exchange = Exchange(timed.sent_ns, reply.received_t_ns, reply.t_ns, timed.arrived_ns)
        if exchange.possible and _EARLIEST_NS <= reply.received_t_ns <= reply.t_ns <= _LATEST_NS:
            found.append(ClockAnswer(exchange, reply.instance))
    return found


async def exchange_once(bus: Bus, node: NodeClock, timeout_s: float = _TIMEOUT_S) -> tuple[Exchange, str] | None:
    """Ask the rig clock once; None when nobody answered. The second value names the clock that did."""
    answers = await exchange_with_all(bus, node, timeout_s)
    if not answers:
        return None
    # Of two clocks always the same one.
    first = min(answers, key=lambda answer: answer.instance)
    return first.exchange, first.instance


async def keep_synced(bus: Bus, clock: SyncedRigClock, ready: asyncio.Event, watch: ClockWatch) -> None:
    """Keep a node's idea of rig time fresh, for ever: quickly at first, then twice a second.

    `ready` is set once rig time is known well enough to stamp samples with it.
    """
    owner = ""
    done = missed = 0
    while True:
        answers = await exchange_with_all(bus, clock.node)
        watch.rivals = max(0, len({answer.instance for answer in answers}) - 1)
        followed = next((answer for answer in answers if answer.instance == owner), None)
        if followed is None and answers:
            missed += 1
            # Exchanges in a row that only another clock answered, after which that one is followed: a
            # second.
            if not owner or missed >= 2:
                if owner:
                    clock.estimator.reset()
                followed = min(answers, key=lambda answer: answer.instance)
                owner, done = followed.instance, 0
        if followed is not None:
            missed = 0
            clock.estimator.add(followed.exchange)
            done += 1
            # Samples are stamped from then on; of so few the shortest round trip is a fair one. Chosen.
            if done >= 4:
                ready.set()
        quick = done < _FIRST_EXCHANGES
        await asyncio.sleep(_FIRST_INTERVAL_S if quick else _INTERVAL_S)


async def watch_for_rivals(bus: Bus, node: NodeClock, instance: str, watch: ClockWatch) -> None:
    """See for ever whether another process answers `rhot/clock`, too; for the owner of the rig clock."""
    while True:
        answers = await exchange_with_all(bus, node)
        watch.rivals = len({answer.instance for answer in answers} - {instance})
        await asyncio.sleep(_INTERVAL_S)
