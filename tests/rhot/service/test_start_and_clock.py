"""Start, stop and rig time, against a real router: who joins late, clocks that are wrong or set back."""

from __future__ import annotations

import asyncio
import re
import time
from functools import partial

import msgpack
import pytest
from bus_watch import wait_for_status
from running.doubling_service import (
    LIMIT_S,
    doubler,
    has_refused,
    points_follow,
    running,
    start,
)

from rhot.bus import Answer, Bus, Request, message_answer
from rhot.clock import SkewedClock, SystemClock
from rhot.errors import BusError, WireError
from rhot.messages import ClockReply, Control, encode
from rhot.operation.control import broadcast, followers
from rhot.rig import BusConfig
from rhot.service import ControlState, control
from rhot.service.clock_sync import exchange_with_all, serve_clock
from rhot.service.runner import serve
from rhot_tools.operate.run import _control


async def test_waits_for_start_then_works_then_stops(router: BusConfig) -> None:
    async with running(doubler(), router), await Bus.open(router) as bus:
        await wait_for_status(bus, "fusion/main", lambda status: status.state == "waiting")
        begun = time.time_ns()
        await start(bus, delay_s=0.3)
        await wait_for_status(bus, "fusion/main", lambda status: status.state == "running")
        assert time.time_ns() - begun > 0.29e9, "nobody starts before the start time"
        points = await points_follow(bus)
        assert points.points["thumb"].position[:2] == (1.0, 2.0)
        bus.publisher("rhot/control", Control, reliable=True).put(Control(t_ns=time.time_ns(), action="stop"))
        await wait_for_status(bus, "fusion/main", lambda status: status.state == "waiting" and not status.session)


async def test_who_joins_late_learns_the_start_from_the_others(router: BusConfig) -> None:
    async with running(doubler(), router):
        async with await Bus.open(router) as bus:
            await start(bus)
            await wait_for_status(bus, "fusion/main", lambda status: status.state == "running")
        # The one who said start is gone by now.
        async with running(doubler(owns_clock=False, name="late"), router), await Bus.open(router) as bus:
            status = await wait_for_status(
                bus,
                "late/main",
                # The first answer may have been a slow one: the clock gets better by asking again.
                lambda status: status.state == "running" and (status.clock_uncertainty_s or 1.0) < 0.05,
            )
            assert status.session == "s1"


async def test_two_clocks_are_noticed_by_everybody_and_nobody_jumps(router: BusConfig) -> None:
    async with (
        running(doubler(), router),
        running(doubler(owns_clock=False, name="node"), router),
        await Bus.open(router) as bus,
    ):
        await wait_for_status(bus, "node/main", lambda status: status.clock_offset_s is not None)
        async with await Bus.open(router) as rival:
            rival.queryable("rhot/clock", an_hour_ahead)
            for name in ("fusion/main", "node/main"):
                status = await wait_for_status(bus, name, lambda status: "second fusion" in status.problem)
                assert abs(status.t_ns - time.time_ns()) < 10e9
        for name in ("fusion/main", "node/main"):
            await wait_for_status(bus, name, lambda status: not status.problem)


def an_hour_ahead(request: Request) -> Answer:
    reply = ClockReply(t_ns=time.time_ns() + HOUR_NS, received_t_ns=request.arrived_ns + HOUR_NS, instance="0rival")
    return message_answer(reply, request)


async def test_a_node_with_a_wrong_clock_learns_rig_time(router: BusConfig) -> None:
    clock = SkewedClock(offset_ns=-3_000_000_000, drift_ppm=30.0)
    service = doubler(owns_clock=False, name="node")
    async with running(doubler(), router), await Bus.open(router) as bus:
        task = asyncio.create_task(serve(service, router, clock))
        try:
            status = await wait_for_status(
                bus,
                "node/main",
                lambda status: status.clock_uncertainty_s is not None and status.clock_uncertainty_s < 0.01,
            )
            assert status.clock_offset_s == pytest.approx(3.0, abs=0.01)
            assert abs(status.t_ns - time.time_ns()) < 3e9
        finally:
            task.cancel()
            await asyncio.gather(task, return_exceptions=True)


HOUR_NS = 3_600_000_000_000


async def test_start_and_stop_are_heard_after_the_rig_clock_was_set_back(
    router: BusConfig, monkeypatch: pytest.MonkeyPatch
) -> None:
    async with running(doubler(), router), await Bus.open(router) as bus:
        await wait_for_status(bus, "fusion/main", lambda status: status.state == "waiting")
        true_time_ns = time.time_ns
        with monkeypatch.context() as ahead:
            ahead.setattr(time, "time_ns", lambda: true_time_ns() + HOUR_NS)
            await broadcast(bus, "start", "before", 0.0, LIMIT_S)
            await wait_for_status(bus, "fusion/main", lambda status: status.session == "before")
        # From here on the rig clock is an hour earlier.
        await broadcast(bus, "stop", "", 0.0, LIMIT_S)
        await wait_for_status(bus, "fusion/main", lambda status: status.state == "waiting" and not status.session)
        await broadcast(bus, "start", "after", 0.0, LIMIT_S)
        await wait_for_status(bus, "fusion/main", lambda status: status.session == "after")
        async with running(doubler(owns_clock=False, name="late"), router):
            await wait_for_status(bus, "late/main", lambda status: status.session == "after")


async def test_who_joins_after_the_clock_was_set_back_does_not_wait_for_the_old_start(
    router: BusConfig, monkeypatch: pytest.MonkeyPatch
) -> None:
    async with running(doubler(), router), await Bus.open(router) as bus:
        true_time_ns = time.time_ns
        with monkeypatch.context() as ahead:
            ahead.setattr(time, "time_ns", lambda: true_time_ns() + HOUR_NS)
            await broadcast(bus, "start", "before", 0.0, LIMIT_S)
            await wait_for_status(bus, "fusion/main", lambda status: status.session == "before")
        async with running(doubler(owns_clock=False, name="late"), router):
            await wait_for_status(bus, "late/main", lambda status: status.state == "running")


async def test_refused_starts_are_counted_and_say_why(router: BusConfig) -> None:
    key, encoding = "rhot/control", "application/msgpack;Control"
    async with running(doubler(), router), await Bus.open(router) as bus:
        await wait_for_status(bus, "fusion/main", lambda status: status.state == "waiting")
        garbage = msgpack.packb({"t_ns": 2**63 - 1, "action": "start", "session": "x", "start_t_ns": 2**63 - 1})
        old = encode(Control(t_ns=time.time_ns() - HOUR_NS, action="start", session="old"))
        for number, payload in enumerate((garbage, old), start=1):
            await bus.put(key, payload, encoding)
            status = await wait_for_status(bus, "fusion/main", partial(has_refused, number))
        # It was old by some more when it arrived.
        assert re.search(r"\b36\d\d s off rig time", status.last_error)
        assert status.state == "waiting"
        await start(bus)
        await wait_for_status(bus, "fusion/main", lambda status: status.state == "running")
        await bus.put(key, encode(Control(t_ns=5, action="stop")), encoding)
        await wait_for_status(bus, "fusion/main", lambda status: status.state == "waiting" and not status.session)


async def test_a_stop_needs_no_rig_clock(router: BusConfig) -> None:
    async with running(doubler(owns_clock=False), router), await Bus.open(router) as bus:
        await wait_for_status(bus, "fusion/main", lambda status: status.state == "waiting")
        assert (await broadcast(bus, "stop", "", 0.0, 0.0)).action == "stop"


async def test_the_first_start_of_a_rig_is_known_to_be_followed(
    router: BusConfig, capsys: pytest.CaptureFixture[str]
) -> None:
    async with running(doubler(), router), await Bus.open(router) as bus:
        await wait_for_status(bus, "fusion/main", lambda status: status.state == "waiting")
        await _control(router, "start", "first", 0.0, LIMIT_S)
        assert capsys.readouterr().out == "start first sent to 1 service: fusion/main\n"
        await wait_for_status(bus, "fusion/main", lambda status: status.session == "first")


async def test_a_stop_for_another_session_stops_nothing(router: BusConfig, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(control, "_QUERY_INTERVAL_S", 0.05)
    async with running(doubler(), router), await Bus.open(router) as bus, await Bus.open(router) as other:
        await start(bus, "one")
        await wait_for_status(bus, "fusion/main", lambda status: status.session == "one")
        with pytest.raises(BusError, match="--session two: session one runs; nothing was changed"):
            await _control(router, "stop", "two", 0.0, LIMIT_S)
        sent = await broadcast(other, "stop", "two", 0.0, LIMIT_S)
        await wait_for_status(bus, "fusion/main", lambda status: "is for session two" in status.last_error)
        # Who has sent it is there still, and is asked by the service again and again.
        assert await followers(other, sent, 1.0) == 0
        await wait_for_status(bus, "fusion/main", lambda status: status.session == "one")


async def test_the_sender_of_a_stop_never_answers_for_it(router: BusConfig) -> None:
    """Not even between the moment at which it is sent and the one at which the sender goes on."""
    async with await Bus.open(router) as bus, await Bus.open(router) as other:
        serve_clock(other)
        other.latest("rhot/control")
        asked: list[int] = []

        async def ask() -> None:
            while True:
                asked.append(len(await other.get("rhot/control", timeout_s=1.0)))

        asking = asyncio.create_task(ask())
        for _ in range(50):
            await broadcast(bus, "stop", "two", 0.0, LIMIT_S)
        asking.cancel()
    assert len(asked) > 5
    assert not any(asked)


def in_force(control: ControlState) -> tuple[str, int] | None:
    return None if control.newest is None else (control.newest.action, control.newest.revision)


def test_the_last_broadcast_wins_and_learnt_messages_are_ordered_by_revision() -> None:
    control, now = ControlState(), 10**18
    first = Control(t_ns=now, action="start", session="a", start_t_ns=now)
    assert control.receive(first, now)
    assert not control.receive(first, now), "the same once more"
    with pytest.raises(WireError, match="session b"):
        control.receive(Control(t_ns=now + 1, action="stop", session="b"), now)
    assert in_force(control) == ("start", 1)
    assert control.receive(Control(t_ns=now - HOUR_NS, action="stop"), now), "a stop always stops"
    assert in_force(control) == ("stop", 2)
    assert not control.learn(first.model_copy(update={"revision": 1})), "of before the stop"
    assert control.learn(first.model_copy(update={"revision": 3}))
    with pytest.raises(WireError, match="cannot be true"):
        control.learn(first.model_copy(update={"revision": 2**52}))
    assert control.receive(Control(t_ns=now, action="stop", revision=2**52), now)
    assert in_force(control) == ("stop", 4), "nor does a broadcast raise it beyond reach"


def test_a_start_from_before_rig_time_is_known_waits_until_it_can_be_judged() -> None:
    now = 10**18
    believable, garbage = (Control(t_ns=t, action="start", session="a", start_t_ns=t) for t in (now, 2**62 - 1))
    control = ControlState()
    assert not control.receive(believable, None)
    assert in_force(control) is None
    assert control.judge(now)
    assert in_force(control) == ("start", 1)
    control = ControlState()
    assert not control.receive(garbage, None)
    with pytest.raises(WireError, match="off rig time"):
        control.judge(now)
    assert not control.judge(now)
    assert not control.receive(believable, None)
    assert control.receive(Control(t_ns=5, action="stop"), None)
    assert not control.judge(now), "stopped since"


async def test_without_any_fusion_the_clock_is_unknown_and_said_so(router: BusConfig) -> None:
    from rhot.operation.control import rig_now_ns

    async with await Bus.open(router) as bus:
        with pytest.raises(BusError, match="start fusion first"):
            await rig_now_ns(bus, wait_s=0.0)


@pytest.mark.parametrize("t_ns", [0, 1_000, 2**62 - 1, 2**62 - 10**9, 42 * 10**17])
async def test_a_clock_that_cannot_be_is_not_followed(router: BusConfig, t_ns: int) -> None:
    """Times that it gave would soon not fit into any message, and the node that followed it would end."""

    def impossible(request: Request) -> Answer:
        return message_answer(ClockReply(t_ns=t_ns, received_t_ns=t_ns, instance="stranger"), request)

    async with await Bus.open(router) as bus, await Bus.open(router) as stranger:
        stranger.queryable("rhot/clock", impossible)
        assert await exchange_with_all(bus, SystemClock()) == []
        async with running(doubler(), router):
            await wait_for_status(bus, "fusion/main", lambda status: status.state == "waiting")
            found = await exchange_with_all(bus, SystemClock())
            assert [answer.instance == "stranger" for answer in found] == [False]
