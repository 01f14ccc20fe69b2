"""The bus against a real router inside the process."""

from __future__ import annotations

import asyncio
import contextlib
import json
import threading
import time
from types import SimpleNamespace
from typing import cast

import msgpack
import pytest
import zenoh
from bus_watch import PATIENCE_S, answers, settled

from rhot.bus import Answer, Bus, Publisher, Request
from rhot.bus.query import received
from rhot.errors import BusError, ConfigError
from rhot.messages import Control, Marker, MarkerFrame, decode, encode
from rhot.rig import BusConfig


def frame(t_ns: int, camera: str = "left") -> MarkerFrame:
    return MarkerFrame(
        t_ns=t_ns,
        camera=camera,
        width=640,
        height=480,
        markers={"thumb": Marker(u=1.0, v=2.0, area=3.0, score=0.5)},
    )


async def test_a_key_expression_that_is_none_is_an_error_of_ours(router: BusConfig) -> None:
    async with await Bus.open(router) as bus:
        with pytest.raises(BusError, match=r"^a//b: Invalid Key Expr `a//b`: empty chunks are forbidden"):
            bus.events("a//b")
        with pytest.raises(BusError, match=r"rhot/\*\*\$"):
            bus.latest("rhot/points", "rhot/**$")


async def test_a_message_arrives_as_sent_and_numbered(router: BusConfig) -> None:
    async with await Bus.open(router) as sender, await Bus.open(router) as receiver:
        mailbox = receiver.events("rhot/markers/*")
        publisher = sender.publisher("rhot/markers/left", MarkerFrame)
        assert await publisher.wait_for_reader(PATIENCE_S)
        for t_ns in (10, 20, 30):
            publisher.put(frame(t_ns))
        received = []
        async with asyncio.timeout(PATIENCE_S):
            async for sample in mailbox:
                assert sample.key == "rhot/markers/left"
                assert sample.encoding == "application/msgpack;MarkerFrame"
                received.append(decode(sample.payload, MarkerFrame))
                if len(received) == 3:
                    break
    assert [(message.t_ns, message.seq) for message in received] == [(10, 0), (20, 1), (30, 2)]


async def test_invalid_messages_are_skipped(router: BusConfig) -> None:
    async with await Bus.open(router) as sender, await Bus.open(router) as receiver:
        mailbox = receiver.events("rhot/markers/*")
        publisher = sender.publisher("rhot/markers/left", MarkerFrame)
        assert await publisher.wait_for_reader(PATIENCE_S)
        for payload in (b"", b"garbage", encode(Control(t_ns=1, action="stop")), encode(frame(20))):
            await sender.put("rhot/markers/left", payload, "application/msgpack;MarkerFrame")
        async with asyncio.timeout(PATIENCE_S):
            async for sample, message in mailbox.messages(MarkerFrame):
                assert (sample.key, message.t_ns) == ("rhot/markers/left", 20)
                break


async def test_a_slow_reader_gets_the_newest_of_each_key_and_the_loss_is_counted(router: BusConfig) -> None:
    async with await Bus.open(router) as sender, await Bus.open(router) as receiver:
        mailbox = receiver.latest("rhot/markers/*")
        publishers = {name: sender.publisher(f"rhot/markers/{name}", MarkerFrame) for name in ("left", "right")}
        for publisher in publishers.values():
            assert await publisher.wait_for_reader(PATIENCE_S)
        for t_ns in range(50):
            for name, publisher in publishers.items():
                publisher.put(frame(t_ns, name))
        async with asyncio.timeout(PATIENCE_S):
            while mailbox.received < 100:
                await asyncio.sleep(0.001)
            newest = {}
            async for sample in mailbox:
                newest[sample.key] = decode(sample.payload, MarkerFrame).t_ns
                if len(newest) == 2:
                    break
    assert newest == {"rhot/markers/left": 49, "rhot/markers/right": 49}
    assert mailbox.overwritten == 98


async def test_the_last_value_answers_queries_as_msgpack_and_as_json(router: BusConfig) -> None:
    async with await Bus.open(router) as sender, await Bus.open(router) as asker:
        publisher = sender.publisher("rhot/markers/left", MarkerFrame)
        assert await asker.get("rhot/markers/*") == [], "nothing before the first message"
        publisher.put(frame(5))
        publisher.put(frame(6))
        (packed,) = await answers(asker, "rhot/markers/left")
        (text,) = await answers(asker, "rhot/**?format=json")
    assert decode(packed.payload, MarkerFrame).t_ns == 6
    assert json.loads(text.payload)["markers"]["thumb"]["u"] == 1.0
    assert text.encoding == "application/json"


async def test_plain_zenoh_reads_the_keys_without_our_code(router: BusConfig) -> None:
    async with await Bus.open(router) as sender, await Bus.open(router) as asker:
        sender.publisher("rhot/markers/left", MarkerFrame).put(frame(5))
        await answers(asker, "rhot/markers/left")
        config = zenoh.Config.from_json5(json.dumps({"mode": "client", "connect": {"endpoints": list(router.connect)}}))

        def ask() -> list[zenoh.Reply]:
            with zenoh.open(config) as session:
                return list(session.get("rhot/**"))

        (reply,) = await asyncio.to_thread(ask)
        assert reply.ok is not None
        assert msgpack.unpackb(reply.ok.payload.to_bytes())["t_ns"] == 5


async def test_a_handler_that_fails_answers_with_its_reason(router: BusConfig) -> None:
    def refuse(request: Request) -> Answer:
        raise ConfigError(f"no such mask: {request.parameters['mask']}")

    def crash(request: Request) -> Answer:
        raise ZeroDivisionError("oops")

    async with await Bus.open(router) as server, await Bus.open(router) as asker:
        server.queryable("rhot/preview/left", refuse, slow=True)
        server.queryable("rhot/crash", crash)
        (refused,) = await answers(asker, "rhot/preview/left?mask=toe")
        (crashed,) = await answers(asker, "rhot/crash")
    assert refused.error == "no such mask: toe"
    assert "oops" in crashed.error


async def test_who_is_there_but_silent_is_told_from_nobody(router: BusConfig) -> None:
    released = threading.Event()

    def answer(request: Request) -> Answer:
        released.wait(PATIENCE_S)
        return Answer(b"late", "text/plain")

    async with await Bus.open(router) as server, await Bus.open(router) as asker:
        server.queryable("rhot/preview/left", answer, slow=True)
        await settled(server)
        try:
            (silent,) = await asker.get("rhot/preview/left", timeout_s=0.1)
            assert silent.error == "no answer within 0.1 s"
            assert await asker.get("rhot/preview/right", timeout_s=PATIENCE_S) == []
        finally:
            released.set()


def test_one_error_stands_for_the_silent_whoever_notices_first() -> None:
    """Beside load the router's timer and the session's both fire for one query."""

    def refusal(text: str) -> zenoh.Reply:
        payload = SimpleNamespace(to_string=lambda: text)
        return cast(zenoh.Reply, SimpleNamespace(ok=None, err=SimpleNamespace(payload=payload)))

    now_s = time.monotonic()
    replies = received([refusal("Timeout"), refusal("no such mask"), refusal("Timeout")], 10.0, now_s)
    assert [reply.error for reply in replies] == ["no such mask", "no answer within 10 s"]
    assert received([], 10.0, now_s) == []
    # Neither timer told: the time that passed does.
    assert [reply.error for reply in received([], 0.1, now_s - 0.1)] == ["no answer within 0.1 s"]


async def test_liveliness_tells_those_already_there_and_who_leaves(router: BusConfig) -> None:
    async with await Bus.open(router) as watcher:
        service = await Bus.open(router)
        service.alive("rhot/alive/capture/left")
        mailbox = watcher.liveliness("rhot/alive/**")
        async with asyncio.timeout(PATIENCE_S):
            seen = []
            async for sample in mailbox:
                seen.append((sample.key, sample.deleted))
                if len(seen) == 1:
                    await service.close()
                else:
                    break
    assert seen == [("rhot/alive/capture/left", False), ("rhot/alive/capture/left", True)]


async def test_namespaces_keep_rigs_apart(router: BusConfig) -> None:
    configs = [router.model_copy(update={"namespace": name}) for name in ("desk1", "desk2")]
    async with (
        await Bus.open(configs[0]) as first,
        await Bus.open(configs[0]) as same_rig,
        await Bus.open(configs[1]) as other_rig,
    ):
        first.publisher("rhot/control", Control).put(Control(t_ns=1, action="stop"))
        assert len(await answers(same_rig, "rhot/control")) == 1
        assert await other_rig.get("rhot/control") == []


async def test_a_router_that_comes_later_is_waited_for_and_one_that_returns_is_used_again(endpoint: str) -> None:
    client = BusConfig(connect=(endpoint,))
    server = BusConfig(mode="router", connect=(), listen=(endpoint,))
    opening = asyncio.create_task(Bus.open(client))
    first = await Bus.open(server)
    async with await opening as sender, await Bus.open(client) as receiver:
        mailbox = receiver.latest("rhot/control")
        publisher = sender.publisher("rhot/control", Control, reliable=True)
        assert await publisher.wait_for_reader(PATIENCE_S)
        await first.close()
        async with await Bus.open(server), asyncio.timeout(PATIENCE_S):
            reading = asyncio.create_task(mailbox.next())
            while not reading.done():
                publisher.put(Control(t_ns=9, action="stop"))
                await asyncio.wait((reading,), timeout=0.05)
            assert decode((await reading).payload, Control).t_ns == 9


@pytest.mark.parametrize(
    ("config", "says"),
    [
        (BusConfig(connect=("unixsock-stream//nonexistent/z.sock",)), "no Zenoh router answers"),
        (BusConfig(connect=("nonsense",)), "not a usable Zenoh configuration"),
        (BusConfig(mode="router", connect=(), listen=("tcp/203.0.113.1:1",)), "cannot open a Zenoh router"),
    ],
)
async def test_opening_in_vain_says_what_to_do(config: BusConfig, says: str) -> None:
    with pytest.raises(BusError, match=says):
        await Bus.open(config, timeout_s=0.2)


async def test_a_wrong_selector_is_an_error_of_ours(router: BusConfig) -> None:
    async with await Bus.open(router) as bus:
        with pytest.raises(BusError, match="rhot//x"):
            await bus.get("rhot//x")


@pytest.mark.filterwarnings("error::pytest.PytestUnhandledThreadExceptionWarning")
async def test_closing_while_threads_still_publish_ends_quietly(router: BusConfig) -> None:
    for _ in range(20):
        bus = await Bus.open(router)
        publishers = [bus.publisher(f"rhot/markers/c{k}", MarkerFrame) for k in range(4)]

        def publish(publishers: list[Publisher[MarkerFrame]] = publishers) -> None:
            with contextlib.suppress(BusError):
                while True:
                    for publisher in publishers:
                        publisher.put(frame(1))

        thread = threading.Thread(target=publish)
        thread.start()
        await bus.close()
        await asyncio.to_thread(thread.join, PATIENCE_S)
        assert not thread.is_alive(), "what was put after the end says that the session is closed"
