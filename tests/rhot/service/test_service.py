"""The service runner against a real router: garbage, configuration, absent devices, signals, its end."""

from __future__ import annotations

import asyncio
import json
import math
import os
import signal
import time
from functools import partial
from types import SimpleNamespace

import msgpack
import pytest
from bus_watch import wait_for_status
from pydantic import BaseModel
from running.doubling_service import (
    LIMIT_S,
    doubler,
    frame,
    has_refused,
    points_follow,
    running,
    start,
)

from rhot.bus import Bus
from rhot.clock import SystemClock
from rhot.errors import ConfigError, DeviceError, WireError
from rhot.messages import Control, Marker, MarkerFrame, ServiceStatus, encode
from rhot.rig import BusConfig, FusionConfig
from rhot.service import CoreService, Node, configuration
from rhot.service.runner import serve


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


async def test_a_service_ends_with_the_task_that_runs_it(router: BusConfig) -> None:
    ended = asyncio.Event()

    class Noting(CoreService[MarkerFrame, FusionConfig]):
        async def run(self, node: Node, start: Control) -> None:
            try:
                await super().run(node, start)
            finally:
                ended.set()

    async with await Bus.open(router) as bus:
        async with running(doubler(kind=Noting), router):
            await start(bus)
            await points_follow(bus)
        assert ended.is_set()


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


class Failing(CoreService[MarkerFrame, FusionConfig]):
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


async def test_a_terminal_that_is_closed_ends_it_in_order(router: BusConfig) -> None:
    async with await Bus.open(router) as bus:
        task = asyncio.create_task(serve(doubler(), router, SystemClock()))
        await wait_for_status(bus, "fusion/main", lambda status: status.state == "waiting")
        # From the shell and from the kernel.
        for _ in range(2):
            os.kill(os.getpid(), signal.SIGHUP)
        async with asyncio.timeout(LIMIT_S):
            assert await task == 0


async def test_nohup_is_obeyed(router: BusConfig) -> None:
    before = signal.signal(signal.SIGHUP, signal.SIG_IGN)
    try:
        async with running(doubler(), router), await Bus.open(router) as bus:
            await wait_for_status(bus, "fusion/main", lambda status: status.state == "waiting")
            assert signal.getsignal(signal.SIGHUP) == signal.SIG_IGN
    finally:
        signal.signal(signal.SIGHUP, before)


async def test_a_signal_ends_it_where_event_loops_take_no_handlers(
    router: BusConfig, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As on Windows, where `rhot objects` runs beside SteamVR."""

    def refuse(*_: object) -> None:
        raise NotImplementedError

    monkeypatch.setattr(asyncio.get_running_loop(), "add_signal_handler", refuse)
    monkeypatch.setattr("rhot.service.stop.sys", SimpleNamespace(platform="win32"))
    before = {number: signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)}
    try:
        async with await Bus.open(router) as bus:
            task = asyncio.create_task(serve(doubler(), router, SystemClock()))
            await wait_for_status(bus, "fusion/main", lambda status: status.state == "waiting")
            os.kill(os.getpid(), signal.SIGINT)
            async with asyncio.timeout(LIMIT_S):
                assert await task == 130
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


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


class Nested(BaseModel):
    """A configuration with maps."""

    gains: dict[str, float] = {"a": 1.0, "b": 2.0}
    name: str = "x"


class Box(BaseModel):
    """A part with two required fields."""

    low: float
    high: float


class Strict(BaseModel, extra="forbid"):
    """A configuration that knows its fields."""

    name: str = "x"
    boxes: dict[str, Box] = {"thumb": Box(low=0.0, high=1.0)}


def test_changes_are_merged_field_by_field() -> None:
    assert configuration.changed(Nested(), {"gains": {"b": 3.0}}) == Nested(gains={"a": 1.0, "b": 3.0})
    with pytest.raises(ConfigError, match=r"gains\.b"):
        configuration.changed(Nested(), {"gains": {"b": "wide"}})
    with pytest.raises(WireError, match="map"):
        configuration.parse_change(b"\x05")


@pytest.mark.parametrize(
    ("change", "says"),
    [
        ({"nam": "y"}, r"nam: no such field; did you mean name\?"),
        ({"boxes": {"thmb": {"low": 2.0}}}, r"boxes\.thmb: no such field; did you mean boxes\.thumb\?"),
        ({"zzz": 1}, "zzz: no such field$"),
    ],
)
def test_a_misspelt_setting_is_named_not_what_it_lacks(change: dict[str, object], says: str) -> None:
    with pytest.raises(ConfigError, match=says):
        configuration.changed(Strict(), change)
