"""What the page takes from the bus and asks of it, over a real router."""

from __future__ import annotations

import asyncio
import json
import time
from collections.abc import AsyncIterator, Awaitable
from functools import partial
from types import SimpleNamespace
from typing import cast

import pytest
from bus_watch import PATIENCE_S, answers, until
from stub_rig import StubRig

from rhot.bus import Answer, Bus, Request, Sample
from rhot.clock import LocalRigClock, SystemClock
from rhot.errors import ConfigError
from rhot.messages import HandPose, ObjectPose, PointSet, ServiceStatus, encode
from rhot.rig import BusConfig
from rhot.service import Node, StatusBoard
from rhot.service.configuration import changed, config_answer, parse_change
from rhot_capture.settings import CameraSettings
from rhot_viewer.rig import capture_settings, picture_feed
from rhot_viewer.rig import inbox as inbox_module
from rhot_viewer.rig.capture_settings import CaptureSettings
from rhot_viewer.rig.inbox import Inbox
from rhot_viewer.rig.picture_feed import Picture, PictureFeed


@pytest.fixture
async def bus(router: BusConfig) -> AsyncIterator[Bus]:
    """The services' session."""
    async with await Bus.open(router) as session:
        yield session


@pytest.fixture
async def viewer_bus(router: BusConfig) -> AsyncIterator[Bus]:
    """The viewer's session."""
    async with await Bus.open(router) as session:
        yield session


@pytest.fixture(autouse=True)
def patient(monkeypatch: pytest.MonkeyPatch) -> None:
    """Who is there answers, however late; who is not there is known at once."""
    for module in (capture_settings, picture_feed):
        monkeypatch.setattr(module, "_TIMEOUT_S", PATIENCE_S)


class Audience:
    """Somebody who looks at a page, or nobody."""

    def __init__(self, *, looking: bool) -> None:
        self._looking, self._away = asyncio.Event(), asyncio.Event()
        self.look(looking)

    def look(self, looking: bool) -> None:
        come, go = (self._looking, self._away) if looking else (self._away, self._looking)
        come.set()
        go.clear()

    async def looked_at(self) -> None:
        await self._looking.wait()

    async def left(self) -> None:
        await self._away.wait()


class Running:
    """A task that is ended with the block."""

    def __init__(self, work: Awaitable[None]) -> None:
        self._task = asyncio.ensure_future(work)

    async def __aenter__(self) -> None:
        return

    async def __aexit__(self, *_: object) -> None:
        self._task.cancel()
        await asyncio.gather(self._task, return_exceptions=True)


async def test_the_inbox_keeps_the_newest_and_counts_garbage(bus: Bus, viewer_bus: Bus, stub: StubRig) -> None:
    clock = SystemClock()
    node = Node("viewer", "main", viewer_bus, clock, LocalRigClock(clock), StatusBoard())
    inbox = Inbox()
    async with Running(inbox.run(node, Audience(looking=True))):
        await asyncio.sleep(0)  # it subscribes
        bus.alive("rhot/alive/ik/main")
        hands = bus.publisher("rhot/hand/right", HandPose)
        assert await hands.wait_for_reader(PATIENCE_S)
        for tick in range(3):
            message = stub.messages(1.0, 10**18 + tick, 0)["rhot/hand/right"]
            assert isinstance(message, HandPose)
            hands.put(message)

        def newest() -> HandPose | None:
            return inbox.newest("rhot/hand/right", HandPose, 10 * PATIENCE_S)

        await until(lambda: (pose := newest()) and pose.t_ns == 10**18 + 2)
        assert newest() is newest(), "decoded once"
        assert inbox.newest("rhot/hand/right", HandPose, 0.0) is None, "too old"
        assert inbox.newest("rhot/hand/left", HandPose, 10 * PATIENCE_S) is None
        assert set(inbox.all_newest("rhot/hand/", HandPose, 10 * PATIENCE_S)) == {"right"}
        await until(lambda: inbox.alive == {"ik/main"})

        garbage = b"\xc1 no message"
        await bus.put("rhot/hand/right", garbage, "application/msgpack")
        await bus.put("rhot/points", encode(message), "application/msgpack;HandPose")
        await until(lambda: newest() is None)
        await until(
            lambda: inbox.newest("rhot/points", PointSet, 10 * PATIENCE_S) or node.status.counts["invalid"] >= 2
        )
        assert inbox.newest("rhot/points", PointSet, 10 * PATIENCE_S) is None
        assert node.status.counts["invalid"] == 2, "each once, however often it is looked at"


async def test_what_moves_is_subscribed_to_only_while_somebody_looks(bus: Bus, viewer_bus: Bus, stub: StubRig) -> None:
    clock = SystemClock()
    node = Node("viewer", "main", viewer_bus, clock, LocalRigClock(clock), StatusBoard())
    inbox, audience = Inbox(), Audience(looking=False)
    hands = bus.publisher("rhot/hand/right", HandPose)
    statuses = bus.publisher("rhot/status/ik/main", ServiceStatus)
    async with Running(inbox.run(node, audience)):
        assert await statuses.wait_for_reader(PATIENCE_S)
        assert not hands.has_reader
        for _ in range(2):
            audience.look(True)
            assert await hands.wait_for_reader(PATIENCE_S)
            audience.look(False)
            await until(lambda: not hands.has_reader)


async def test_strangers_names_shut_nobody_out(
    bus: Bus, viewer_bus: Bus, stub: StubRig, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(inbox_module, "_MAX_KEYS", 8)
    clock = SystemClock()
    node = Node("viewer", "main", viewer_bus, clock, LocalRigClock(clock), StatusBoard())
    inbox = Inbox()
    hands = bus.publisher("rhot/hand/right", HandPose)
    message = stub.messages(1.0, 10**18, 0)["rhot/hand/right"]
    assert isinstance(message, HandPose)
    async with Running(inbox.run(node, Audience(looking=True))):
        assert await hands.wait_for_reader(PATIENCE_S)
        hands.put(message)
        await until(lambda: inbox.newest("rhot/hand/right", HandPose, 10 * PATIENCE_S))
        # Garbage makes room for garbage; what has been valid stays.
        for number in range(40):
            await bus.put(f"rhot/object/stranger{number}", b"\xc1", "application/msgpack")
        await until(lambda: "rhot/object/stranger39" in inbox._slots)
        assert "rhot/hand/right" in inbox._slots
        assert len(inbox._slots) <= 8
        # Where all names are valid, those go that have been silent longest.
        cube = stub.messages(1.0, 10**18, 0)["rhot/object/cube"]
        for number in range(40):
            await bus.put(f"rhot/object/box{number}", encode(cube), "application/msgpack")
            await until(partial(inbox.newest, f"rhot/object/box{number}", ObjectPose, 10 * PATIENCE_S))
        assert len(inbox._slots) <= 8
        hands.put(message)
        await until(lambda: inbox.newest("rhot/hand/right", HandPose, 10 * PATIENCE_S))


class Mailbox:
    """Statuses of so many cameras, and then nothing more."""

    def __init__(self, statuses: int) -> None:
        self._statuses = statuses

    async def __aiter__(self) -> AsyncIterator[Sample]:
        for number in range(self._statuses):
            status = ServiceStatus(t_ns=1, service="capture", instance=f"c{number}", state="running")
            yield Sample(f"rhot/status/capture/c{number}", encode(status), "", False, time.monotonic_ns())
        await asyncio.Event().wait()

    def keep_slot_of(self, key: str) -> None:
        """Nobody else's keys come."""


class WaitingStatuses:
    """A bus on which the statuses of a large rig wait, and nothing else comes."""

    def latest(self, *key_exprs: str) -> Mailbox:
        return Mailbox(20 if key_exprs == ("rhot/status/*/*",) else 0)

    def liveliness(self, key_expr: str) -> Mailbox:
        return Mailbox(0)


async def test_all_statuses_that_wait_are_taken_at_once(monkeypatch: pytest.MonkeyPatch) -> None:
    rests: list[float] = []
    sleep = asyncio.sleep

    async def counted(delay_s: float) -> None:
        rests.append(delay_s)
        await sleep(0)

    inbox = Inbox()
    monkeypatch.setattr("rhot_viewer.rig.inbox.asyncio.sleep", counted)
    node = SimpleNamespace(bus=WaitingStatuses(), refuse=None)
    async with Running(inbox.run(cast(Node, node), Audience(looking=False))):
        for _ in range(100):
            await sleep(0)
        assert len(inbox.all_newest("rhot/status/", ServiceStatus, 10 * PATIENCE_S)) == 20
    assert len(rests) == 1


class StubCamera:
    """Settings as a capture service keeps them."""

    def __init__(self, bus: Bus) -> None:
        self.settings = CameraSettings(exposure_s=0.004, gain=4.0, white_balance=(1.6, 1.6), tolerances={"thumb": 1.0})
        self.payloads: list[bytes] = []
        bus.queryable("rhot/config/capture/left", self._answer)

    def _answer(self, request: Request) -> Answer:
        self.payloads.append(request.payload)
        if request.payload:
            self.settings = changed(self.settings, parse_change(request.payload))
        return config_answer(self.settings, request)


async def test_settings_are_read_changed_and_refused(bus: Bus, viewer_bus: Bus) -> None:
    camera = StubCamera(bus)
    settings = CaptureSettings(["left", "silent"])

    def left() -> int:
        return settings.cameras["left"].version

    await answers(viewer_bus, "rhot/config/capture/left")
    camera.payloads.clear()
    async with Running(settings.run(viewer_bus)):
        settings.ask("left", {})
        await until(lambda: left() == 1)
        assert settings.cameras["left"].settings["gain"] == 4.0

        # What comes faster than it is answered goes out as one.
        settings.ask("left", {"gain": 5.0})
        settings.ask("left", {"gain": 6.0, "tolerances": {"thumb": 1.5}})
        assert settings.is_asked("left")
        await until(lambda: left() == 2 and not settings.is_asked("left"))
        assert (camera.settings.gain, camera.settings.tolerances) == (6.0, {"thumb": 1.5})
        assert [json.loads(payload or b"{}") for payload in camera.payloads] == [
            {},
            {"gain": 6.0, "tolerances": {"thumb": 1.5}},
        ]

        settings.ask("left", {"gain": 1000.0})
        await until(lambda: left() == 3)
        state = settings.cameras["left"]
        assert "gain" in state.refusal
        assert state.settings["gain"] == 6.0, "where the slider goes back to"
        settings.ask("left", {})
        await until(lambda: left() == 4)
        assert "gain" in settings.cameras["left"].refusal, "reading takes no reason away"
        settings.ask("left", {"gain": 3.0})
        await until(lambda: left() == 5)
        assert settings.cameras["left"].refusal == ""

        settings.ask("silent", {"gain": 2.0})
        await until(lambda: settings.cameras["silent"].version == 1)
        assert "rhot capture --camera silent" in settings.cameras["silent"].refusal


async def test_pictures_are_asked_for_only_while_somebody_looks(bus: Bus, viewer_bus: Bus) -> None:
    asked: list[dict[str, str]] = []

    def answer(request: Request) -> Answer:
        asked.append(dict(request.parameters))
        if request.parameters.get("mask") == "toe":
            raise ConfigError("mask=toe: no such marker")
        return Answer(b"\xff\xd8 a picture", "image/jpeg")

    def answer_of_feet(request: Request) -> Answer:
        of_feet.append(dict(request.parameters))
        return Answer(b"\xff\xd8 feet", "image/jpeg")

    of_feet: list[dict[str, str]] = []
    bus.queryable("rhot/preview/left", answer)
    bus.queryable("rhot/preview/feet", answer_of_feet)
    for camera in ("left", "feet"):
        await answers(viewer_bus, f"rhot/preview/{camera}")
    asked.clear()
    shown: list[tuple[str, Picture]] = []
    feed = PictureFeed(["left", "silent", "feet"], lambda camera, picture: shown.append((camera, picture)))
    looked_at = asyncio.Event()
    async with Running(feed.run(viewer_bus, lambda: 60.0, looked_at.wait)):
        await asyncio.sleep(0.05)
        assert asked == []
        looked_at.set()
        await until(lambda: len(shown) == 3)
        assert asked == [{"overlay": "markers"}]
        assert shown[0] == ("left", Picture(jpeg=b"\xff\xd8 a picture"))
        assert "rhot capture --camera silent" in shown[1][1].problem
        feed.select("thumb")  # at once, not after the interval
        await until(lambda: len(shown) == 6)
        assert asked[-1] == {"mask": "thumb"}
        assert of_feet[-1] == {"overlay": "markers"}, "the feet's camera knows no masks"
        assert shown[-1] == ("feet", Picture(jpeg=b"\xff\xd8 feet"))
        feed.select("toe")
        await until(lambda: len(shown) == 9)
        assert shown[-3] == ("left", Picture(problem="mask=toe: no such marker"))
