"""What a stranger sends piles up nowhere: every bound of the bus, against a real router."""

from __future__ import annotations

import asyncio
import threading
import time
from typing import Any, cast

import msgpack
import pytest
import zenoh
from bus_watch import PATIENCE_S, answers, settled, until

from rhot.bus import Answer, Bus, EventSubscriber, LatestSubscriber, Request
from rhot.bus.query import received
from rhot.bus.zenoh_config import (
    MAX_FOREIGN_KEYS,
    MAX_MESSAGE_BYTES,
    MAX_SAMPLE_BYTES,
    MAX_UNREAD_BYTES,
    MAX_WAITING_ANSWERS,
    LimitCounts,
    session_config,
)
from rhot.clock import SystemClock
from rhot.rig import BusConfig

HOSTILE_KEY = "rhot/alive/x/[/red]\x1b[2J\nroot"


def sample(key: str, size: int = 8) -> zenoh.Sample:
    return cast(zenoh.Sample, FakeSample(key, size))


class FakePayload:
    """Bytes that notice when they are copied."""

    def __init__(self, size: int) -> None:
        self.size = size
        self.copied = False

    def __len__(self) -> int:
        return self.size

    def to_bytes(self) -> bytes:
        self.copied = True
        return bytes(self.size)


class FakeSample:
    """What Zenoh calls back with."""

    kind = zenoh.SampleKind.PUT
    encoding = "application/msgpack"

    def __init__(self, key: str, size: int) -> None:
        self.key_expr = key
        self.payload = FakePayload(size)


async def taken(mailbox: LatestSubscriber | EventSubscriber, number: int) -> list[str]:
    found = []
    async for read in mailbox:
        found.append(read.key)
        if len(found) == number:
            break
    return found


def test_zenoh_puts_no_large_message_together() -> None:
    config = session_config(BusConfig())
    assert config.get_json("transport/link/rx/max_message_size") == str(MAX_MESSAGE_BYTES)


async def test_foreign_keys_get_few_slots_and_never_those_of_the_rig() -> None:
    limits = LimitCounts()
    mailbox = LatestSubscriber(limits)
    mailbox(sample("rhot/markers/left"))
    assert await taken(mailbox, 1) == ["rhot/markers/left"]
    mailbox.keep_slot_of("rhot/markers/left")
    mailbox(sample("rhot/markers/left"))
    for number in range(20_000):
        mailbox(sample(f"rhot/markers/{number}"))
    read = await taken(mailbox, 1 + MAX_FOREIGN_KEYS)
    assert "rhot/markers/left" in read
    assert read[-1] == "rhot/markers/19999"
    assert limits.counts() == {"foreign_keys_dropped": 20_000 - MAX_FOREIGN_KEYS}


async def test_what_is_too_large_is_not_even_copied() -> None:
    limits = LimitCounts()
    large = sample("rhot/points", MAX_SAMPLE_BYTES + 1)
    for mailbox in (LatestSubscriber(limits), EventSubscriber(10, limits)):
        mailbox(large)
        assert mailbox.received == 0
    assert not cast(Any, large).payload.copied
    assert limits.counts() == {"oversized": 2}


async def test_unread_events_are_bounded_in_bytes() -> None:
    limits = LimitCounts()
    mailbox = EventSubscriber(4096, limits)
    most = MAX_UNREAD_BYTES // MAX_SAMPLE_BYTES
    for number in range(most + 5):
        mailbox(sample(f"rhot/points/{number}", MAX_SAMPLE_BYTES))
    assert mailbox.overwritten == 5
    assert limits.counts() == {"unread_dropped": 5}
    assert (await taken(mailbox, most))[0] == "rhot/points/5"


async def test_questions_that_wait_for_a_worker_are_bounded(router: BusConfig) -> None:
    released = threading.Event()

    def answer(request: Request) -> Answer:
        released.wait(PATIENCE_S)
        return Answer(b"picture", "image/jpeg")

    async with await Bus.open(router) as server, await Bus.open(router) as watcher:
        server.queryable("rhot/preview/left", answer, slow=True)
        await settled(server)
        await settled(watcher)
        # A plain session: at once, and without waiting, as somebody would who means harm.
        asker = await asyncio.to_thread(zenoh.open, session_config(router))
        try:
            asked = [asker.get("rhot/preview/left", timeout=PATIENCE_S) for _ in range(MAX_WAITING_ANSWERS + 3)]
            await until(lambda: server.limit_counts().get("questions_refused") == 3)
            released.set()
            replies = [reply for found in asked for reply in received(found, PATIENCE_S, time.monotonic())]
        finally:
            released.set()
            await asyncio.to_thread(asker.close)
    refused = [reply.error for reply in replies if reply.error]
    assert len(refused) == 3
    assert "ask less often" in refused[0]
    assert len(replies) - len(refused) == MAX_WAITING_ANSWERS


async def test_hostile_keys_and_errors_arrive_as_plain_text(router: BusConfig) -> None:
    async with await Bus.open(router) as stranger, await Bus.open(router) as asker:
        stranger.alive(HOSTILE_KEY)
        mailbox = asker.events("rhot/**")
        await settled(asker)
        await stranger.put(HOSTILE_KEY, b"", "text/plain\x1b[2J")
        async with asyncio.timeout(PATIENCE_S):
            heard = await mailbox.next()
        (alive,) = await asker.who_is_alive()
    for text in (heard.key, heard.encoding, alive.key):
        assert text.isprintable()
    assert heard.key == "rhot/alive/x/[/red]\\u001b[2J\\nroot"


async def test_a_question_with_wildcards_changes_nothing(router: BusConfig) -> None:
    seen: list[Request] = []

    def answer(request: Request) -> Answer:
        seen.append(request)
        return Answer(b"", "text/plain")

    async with await Bus.open(router) as server, await Bus.open(router) as asker:
        server.queryable("rhot/config/ik/main", answer)
        await answers(asker, "rhot/config/ik/main")
        seen.clear()
        for asked in ("rhot/config/ik/main", "rhot/**", "rhot/con$*/ik/main"):
            await asker.get(f"{asked}?do=save;format=json", b"change")
    assert [(request.payload, dict(request.parameters)) for request in seen] == [
        (b"change", {"do": "save", "format": "json"}),
        (b"", {"format": "json"}),
        (b"", {"format": "json"}),
    ]


async def test_changes_reach_a_service_in_a_namespace(router: BusConfig) -> None:
    config = router.model_copy(update={"namespace": "desk1"})
    async with await Bus.open(config) as server, await Bus.open(config) as asker:
        server.queryable("rhot/config/ik/main", lambda request: Answer(request.payload, "text/plain"))
        await answers(asker, "rhot/config/ik/main")
        (reply,) = await asker.get("rhot/config/ik/main", b"change")
    assert reply.payload == b"change"


class DeadLink:
    """A session whose link is dead but not closed: Zenoh waits for room in its queue."""

    def __init__(self) -> None:
        self.options: dict[str, Any] = {}
        self.asked, self.room = threading.Event(), threading.Event()
        self.went_on_meanwhile = False

    def get(self, key: str, handler: Any, **options: Any) -> None:
        self.options = options
        self.asked.set()
        self.went_on_meanwhile = self.room.wait(5.0)
        # zenoh.handlers.Callback holds what it was made of; dropping it ends the query.
        raise zenoh.ZError("no room")


async def test_asking_for_the_time_never_holds_the_event_loop() -> None:
    link = DeadLink()
    bus = Bus(cast(zenoh.Session, link), BusConfig())
    asking = asyncio.create_task(bus.ask("rhot/clock", SystemClock().now_ns, 1.0))
    await until(link.asked.is_set)
    link.room.set()
    with pytest.raises(Exception, match="no room"):
        await asking
    assert link.went_on_meanwhile
    assert link.options["congestion_control"] == zenoh.CongestionControl.DROP
    assert link.options["priority"] == zenoh.Priority.REAL_TIME


async def test_answers_to_one_question_are_bounded(router: BusConfig, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("rhot.bus.query.MAX_REPLIES", 5)
    async with await Bus.open(router) as stranger, await Bus.open(router) as asker:
        for number in range(9):
            stranger.queryable(f"rhot/status/x/{number}", lambda request: Answer(msgpack.packb({}), "x"))
        await settled(stranger)
        async with asyncio.timeout(PATIENCE_S):
            while len(await asker.get("rhot/status/**", timeout_s=PATIENCE_S)) != 5:
                await asyncio.sleep(0.001)
