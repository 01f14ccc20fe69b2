"""The service runner against a real router: start, late join, stop, restart of anything, garbage, configuration."""

from __future__ import annotations

import asyncio
import json
import math
import os
import signal
import time
from collections.abc import AsyncIterator, Callable, Mapping
from contextlib import asynccontextmanager
from functools import partial

import msgpack
import pytest
from pydantic import BaseModel

from rhot.bus import Answer, Bus, Request, message_answer
from rhot.clock import SkewedClock, SystemClock
from rhot.errors import BusError, ConfigError, DeviceError, WireError
from rhot.messages import ClockReply, Control, Marker, MarkerFrame, Point, PointSet, ServiceStatus, decode, encode
from rhot.operation.control import broadcast
from rhot.rig import BusConfig, FusionConfig
from rhot.service import ControlState, Node, StageService, configuration, runner
from rhot.service.runner import serve
from rhot.stage import Output

LIMIT_S = 60.0


@pytest.fixture(autouse=True)
def quick_status(monkeypatch: pytest.MonkeyPatch) -> None:
    """Publish the status often, so that tests need not wait for the next second."""
    monkeypatch.setattr(runner, "_STATUS_INTERVAL_S", 0.05)


class Doubler:
    """A stage that puts each marker into space, and can be told to fail."""

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


Doubling = StageService[MarkerFrame, FusionConfig]


def doubler(*, owns_clock: bool = True, name: str = "fusion", kind: type[Doubling] = Doubling) -> Doubling:
    return kind(
        name,
        input_keys="rhot/markers/*",
        model=MarkerFrame,
        key_of=lambda frame: f"rhot/markers/{frame.camera}",
        config=FusionConfig(),
        make_stage=Doubler,
        owns_clock=owns_clock,
    )


def frame(t_ns: int, camera: str = "left") -> MarkerFrame:
    marker = Marker(u=1.0, v=2.0, area=3.0, score=0.5)
    return MarkerFrame(t_ns=t_ns, camera=camera, width=640, height=480, markers={"thumb": marker})


@asynccontextmanager
async def running(service: StageService[MarkerFrame, FusionConfig], bus: BusConfig) -> AsyncIterator[None]:
    """Run a service beside the test; ends it as a signal would."""
    task = asyncio.create_task(serve(service, bus, SystemClock()))
    try:
        yield
    finally:
        task.cancel()
        await asyncio.gather(task, return_exceptions=True)


async def status_of(bus: Bus, name: str) -> ServiceStatus | None:
    replies = await bus.get(f"rhot/status/{name}", timeout_s=1.0)
    return decode(replies[0].payload, ServiceStatus) if replies and not replies[0].error else None


async def wait_for_status(bus: Bus, name: str, wanted: Callable[[ServiceStatus], bool]) -> ServiceStatus:
    async with asyncio.timeout(LIMIT_S):
        while True:
            status = await status_of(bus, name)
            if status is not None and wanted(status):
                return status
            await asyncio.sleep(0.02)


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


def has_refused(number: int, status: ServiceStatus) -> bool:
    return status.counts.get("invalid", 0) >= number


async def test_garbage_is_counted_and_harms_nothing(router: BusConfig) -> None:
    good = msgpack.unpackb(encode(frame(time.time_ns())))

    def with_markers(u: object) -> bytes:
        markers = {"thumb": {"u": u, "v": 1.0, "area": 1.0, "score": 1.0}}
        packed: bytes = msgpack.packb(good | {"markers": markers, "t_ns": time.time_ns()})
        return packed

    garbage = [
        b"",
        b"\xff\x00garbage",
        encode(frame(time.time_ns()))[:-4],
        msgpack.packb([1, 2, 3]),
        msgpack.packb(good | {"t_ns": "now"}),
        with_markers(math.nan),
        with_markers(1e300),
        with_markers("12"),
        encode(frame(time.time_ns() + 10**10)),
        encode(frame(time.time_ns() - 10**10)),
        encode(frame(0)),
        encode(frame(time.time_ns(), camera="other")),
    ]
    async with running(doubler(), router), await Bus.open(router) as bus:
        await start(bus)
        await points_follow(bus)
        before = await wait_for_status(bus, "fusion/main", lambda status: status.state == "running")
        for number, payload in enumerate(garbage, start=before.counts.get("invalid", 0) + 1):
            await bus.put("rhot/markers/left", payload, "application/msgpack;MarkerFrame")
            # Newest wins: the next would replace one that was not looked at yet.
            await wait_for_status(bus, "fusion/main", partial(has_refused, number))
        for key in ("rhot/control", "rhot/config/fusion/main"):
            for payload in (b"", b"\xc1", b"{", b"[]", b"\x93\x01\x02\x03", b'{"nonsense": 1}'):
                await bus.put(key, payload, "application/octet-stream")
        after = await wait_for_status(
            bus,
            "fusion/main",
            lambda status: status.counts.get("invalid", 0) >= before.counts.get("invalid", 0) + len(garbage) + 8,
        )
        assert after.state == "running"
        assert after.last_error
        assert (await points_follow(bus)).points["thumb"].position[0] == 1.0


async def test_a_sample_that_the_core_cannot_digest_costs_only_itself(router: BusConfig) -> None:
    async with running(doubler(), router), await Bus.open(router) as bus:
        await start(bus)
        await points_follow(bus)
        toe = frame(time.time_ns()).model_copy(update={"markers": {"toe": Marker(u=1.0, v=1.0, area=1.0, score=1.0)}})
        await bus.put("rhot/markers/left", encode(toe), "application/msgpack;MarkerFrame")
        status = await wait_for_status(bus, "fusion/main", lambda status: status.counts.get("failed", 0) == 1)
        assert "no toes here" in status.last_error
        await points_follow(bus)


async def test_a_flood_of_bad_samples_fills_no_log(router: BusConfig, caplog: pytest.LogCaptureFixture) -> None:
    async with running(doubler(), router), await Bus.open(router) as bus:
        await start(bus)
        await points_follow(bus)
        toe = {"toe": Marker(u=1.0, v=1.0, area=1.0, score=1.0)}
        for number in range(1, 30):
            bad = frame(time.time_ns()).model_copy(update={"markers": toe})
            await bus.put("rhot/markers/left", encode(bad), "application/msgpack;MarkerFrame")
            await wait_for_status(bus, "fusion/main", partial(has_failed, number))
    tracebacks = [record for record in caplog.records if record.exc_info]
    assert 1 <= len(tracebacks) <= 3


def has_failed(number: int, status: ServiceStatus) -> bool:
    return status.counts.get("failed", 0) >= number


async def test_limits_that_were_reached_stand_in_the_status(router: BusConfig, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("rhot.bus.subscriber.MAX_SAMPLE_BYTES", 1000)
    async with running(doubler(), router), await Bus.open(router) as bus:
        await wait_for_status(bus, "fusion/main", lambda status: status.state == "waiting")
        await bus.put("rhot/control", bytes(1001), "application/msgpack;Control")
        await wait_for_status(bus, "fusion/main", lambda status: status.counts.get("oversized") == 1)


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


async def test_configuration_changes_while_running_and_bad_values_are_refused(router: BusConfig) -> None:
    key = "rhot/config/fusion/main"
    async with running(doubler(), router), await Bus.open(router) as bus:
        await start(bus)
        first = await wait_for_status(bus, "fusion/main", lambda status: status.state == "running")

        async def current() -> float:
            (reply,) = await bus.get(f"{key}?format=json")
            value: float = json.loads(reply.payload)["hold_s"]
            return value

        await bus.put(key, json.dumps({"hold_s": 0.75}).encode(), "application/json")
        changed = await wait_for_status(bus, "fusion/main", lambda status: status.config_digest != first.config_digest)
        assert await current() == 0.75
        assert (await points_follow(bus)).points["thumb"].position[2] == 0.75
        for refused in ({"hold_s": -1}, {"hold_s": "long"}, {"hold": 1}, {"hold_s": 11}):
            await bus.put(key, msgpack.packb(refused), "application/msgpack")
        status = await wait_for_status(bus, "fusion/main", lambda status: status.counts.get("config_refused", 0) == 4)
        assert status.config_digest == changed.config_digest
        assert await current() == 0.75
        (answer,) = await bus.get(key, json.dumps({"hold_s": -2}).encode())
        assert "hold_s" in answer.error
        (answer,) = await bus.get(f"{key}?format=json", json.dumps({"hold_s": 0.5}).encode())
        assert json.loads(answer.payload)["hold_s"] == 0.5


async def test_the_router_may_die_and_come_back(endpoint: str) -> None:
    client = BusConfig(connect=(endpoint,))
    server = BusConfig(mode="router", connect=(), listen=(endpoint,))
    first = await Bus.open(server)
    async with running(doubler(), client), await Bus.open(client) as bus:
        await start(bus)
        await points_follow(bus)
        await first.close()
        async with await Bus.open(server):
            begun = time.monotonic()
            await points_follow(bus)
            assert time.monotonic() - begun < 3.0


class Failing(StageService[MarkerFrame, FusionConfig]):
    """A service whose device is absent at first."""

    tries = 0

    async def run(self, node: Node, start: Control) -> None:
        self.tries += 1
        if self.tries < 3:
            raise DeviceError("no camera at /dev/video7")
        await super().run(node, start)


async def test_a_device_that_is_absent_is_tried_again(router: BusConfig) -> None:
    service = doubler(kind=Failing)
    assert isinstance(service, Failing)
    async with running(service, router), await Bus.open(router) as bus:
        await start(bus)
        status = await wait_for_status(bus, "fusion/main", lambda status: status.counts.get("device_errors", 0) >= 1)
        assert status.last_error == "no camera at /dev/video7"
        await points_follow(bus)
        assert service.tries == 3


class SlowToStop(Failing):
    """A service whose device takes its time to close."""

    async def run(self, node: Node, start: Control) -> None:
        try:
            await asyncio.sleep(LIMIT_S)
        finally:
            self.tries += 1
            await asyncio.sleep(0.3)


async def test_a_signal_right_after_stop_is_not_lost(router: BusConfig) -> None:
    service = doubler(kind=SlowToStop)
    assert isinstance(service, SlowToStop)
    async with await Bus.open(router) as bus:
        task = asyncio.create_task(serve(service, router, SystemClock()))
        await start(bus)
        await wait_for_status(bus, "fusion/main", lambda status: status.state == "running")
        bus.publisher("rhot/control", Control, reliable=True).put(Control(t_ns=time.time_ns(), action="stop"))
        async with asyncio.timeout(LIMIT_S):
            while not service.tries:
                await asyncio.sleep(0.01)
        os.kill(os.getpid(), signal.SIGTERM)
        async with asyncio.timeout(2.0):
            assert await task == 0


async def test_an_error_of_the_service_ends_it_with_that_error(router: BusConfig) -> None:
    class Broken(Failing):
        async def run(self, node: Node, start: Control) -> None:
            raise ConfigError("colors.json vanished")

    service = doubler(kind=Broken)
    task = asyncio.create_task(serve(service, router, SystemClock()))
    async with await Bus.open(router) as bus:
        await start(bus)
        async with asyncio.timeout(LIMIT_S):
            with pytest.raises(ConfigError, match=r"colors\.json vanished"):
                await task


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
        assert "3600 s off rig time" in status.last_error
        assert status.state == "waiting"
        await start(bus)
        await wait_for_status(bus, "fusion/main", lambda status: status.state == "running")
        await bus.put(key, encode(Control(t_ns=5, action="stop")), encoding)
        await wait_for_status(bus, "fusion/main", lambda status: status.state == "waiting" and not status.session)


async def test_a_stop_needs_no_rig_clock(router: BusConfig) -> None:
    async with running(doubler(owns_clock=False), router), await Bus.open(router) as bus:
        await wait_for_status(bus, "fusion/main", lambda status: status.state == "waiting")
        assert (await broadcast(bus, "stop", "", 0.0, 0.0)).action == "stop"


def in_force(control: ControlState) -> tuple[str, int] | None:
    return None if control.newest is None else (control.newest.action, control.newest.revision)


def test_the_last_broadcast_wins_and_learnt_messages_are_ordered_by_revision() -> None:
    control, now = ControlState(), 10**18
    first = Control(t_ns=now, action="start", session="a", start_t_ns=now)
    assert control.hear(first, now)
    assert not control.hear(first, now), "the same once more"
    with pytest.raises(WireError, match="session b"):
        control.hear(Control(t_ns=now + 1, action="stop", session="b"), now)
    assert in_force(control) == ("start", 1)
    assert control.hear(Control(t_ns=now - HOUR_NS, action="stop"), now), "a stop always stops"
    assert in_force(control) == ("stop", 2)
    assert not control.learn(first.model_copy(update={"revision": 1})), "of before the stop"
    assert control.learn(first.model_copy(update={"revision": 3}))
    with pytest.raises(WireError, match="cannot be true"):
        control.learn(first.model_copy(update={"revision": 2**52}))
    assert control.hear(Control(t_ns=now, action="stop", revision=2**52), now)
    assert in_force(control) == ("stop", 4), "nor does a broadcast raise it beyond reach"


def test_a_start_from_before_rig_time_is_known_waits_until_it_can_be_judged() -> None:
    now = 10**18
    believable, garbage = (Control(t_ns=t, action="start", session="a", start_t_ns=t) for t in (now, 2**62 - 1))
    control = ControlState()
    assert not control.hear(believable, None)
    assert in_force(control) is None
    assert control.judge(now)
    assert in_force(control) == ("start", 1)
    control = ControlState()
    assert not control.hear(garbage, None)
    with pytest.raises(WireError, match="off rig time"):
        control.judge(now)
    assert not control.judge(now)
    assert not control.hear(believable, None)
    assert control.hear(Control(t_ns=5, action="stop"), None)
    assert not control.judge(now), "stopped since"


class Nested(BaseModel):
    """A configuration with maps."""

    gains: dict[str, float] = {"a": 1.0, "b": 2.0}
    name: str = "x"


def test_changes_are_merged_field_by_field() -> None:
    assert configuration.changed(Nested(), {"gains": {"b": 3.0}}) == Nested(gains={"a": 1.0, "b": 3.0})
    with pytest.raises(ConfigError, match=r"gains\.b"):
        configuration.changed(Nested(), {"gains": {"b": "wide"}})
    with pytest.raises(WireError, match="map"):
        configuration.parse_change(b"\x05")


async def test_without_any_fusion_the_clock_is_unknown_and_said_so(router: BusConfig) -> None:
    from rhot.operation.control import rig_now_ns

    async with await Bus.open(router) as bus:
        with pytest.raises(BusError, match="start fusion first"):
            await rig_now_ns(bus, wait_s=0.0)
