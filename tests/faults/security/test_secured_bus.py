"""Who may do what on a secured bus: real certificates, a real router, one session a holder."""

from __future__ import annotations

import asyncio
import json
from collections.abc import AsyncIterator, Mapping
from contextlib import AsyncExitStack, asynccontextmanager
from functools import partial
from pathlib import Path

import pytest
import zenoh
from bus_watch import PATIENCE_S, answers, settled, until

from rhot.bus import Answer, Bus, EventSubscriber, Request
from rhot.errors import BusError, ConfigError
from rhot.keys import Holder
from rhot.rig import BusConfig
from rhot.rig.folder import RIG_FILE, load_config
from rhot.rig.template import rig_template
from rhot.rig.toml_edit import change_rig_file
from rhot_tools.keys.making import add_holder, make_keys, remove_holder


def make_secured_rig(folder: Path, port: int, namespace: str = "") -> Path:
    """Make a rig of two cameras with keys, whose router listens on this machine only."""
    folder.mkdir()
    (folder / RIG_FILE).write_text(rig_template(folder="rig", name="test"))
    make_keys(folder, ["127.0.0.1"], port)
    change_rig_file(folder, {("bus",): {"listen": [f"tls/127.0.0.1:{port}"], "namespace": namespace}})
    return folder


def as_holder(folder: Path, identity: str) -> BusConfig:
    """Return how the holder of a certificate reaches the bus."""
    return load_config(folder).bus.model_copy(update={"identity": identity, "listen": ()})


@asynccontextmanager
async def secured_router(folder: Path) -> AsyncIterator[None]:
    """Run the rig's router, as `rhot router` does."""
    bus = load_config(folder).bus
    async with await Bus.open(bus.model_copy(update={"mode": "router", "connect": ()})):
        yield


KEYS = (
    "rhot/markers/left",
    "rhot/markers/right",
    "rhot/points",
    "rhot/hand/right",
    "rhot/control",
    "rhot/config/fusion/main",
    "rhot/config/capture/left",
    "rhot/status/capture/left",
    "rhot/status/fusion/main",
    "rhot/@pictures/left",
)
ENCODING = "application/octet-stream"


@pytest.fixture(params=["", "desk1"], ids=["plain", "namespace"])
async def rig(request: pytest.FixtureRequest, tmp_path: Path, free_port: int) -> AsyncIterator[Path]:
    """A secured rig with a reader, whose router runs."""
    folder = make_secured_rig(tmp_path / "rig", free_port, request.param)
    add_holder(folder, "tablet", Holder(role="tool"))
    async with secured_router(folder):
        yield folder


async def opened(stack: AsyncExitStack, rig: Path, identity: str) -> Bus:
    return await stack.enter_async_context(await Bus.open(as_holder(rig, identity), timeout_s=PATIENCE_S))


class Listener:
    """Everything that one holder gets to hear."""

    def __init__(self, bus: Bus) -> None:
        self.bus = bus
        self.mailboxes: list[EventSubscriber] = [bus.events("rhot/**"), bus.events("rhot/@pictures/**")]
        self.mailboxes += [bus.events(key) for key in KEYS]

    async def heard(self) -> set[tuple[str, bytes]]:
        found = set()
        for mailbox in self.mailboxes:
            mailbox.close()
            async for sample in mailbox:
                found.add((sample.key, sample.payload))
        return found


def has_heard(mailbox: EventSubscriber, number: int) -> bool:
    return mailbox.received >= number


async def test_each_role_publishes_and_hears_what_it_may(rig: Path) -> None:
    may_put = {
        "camera-left": {"rhot/markers/left", "rhot/status/capture/left", "rhot/@pictures/left"},
        "services": {"rhot/points", "rhot/hand/right", "rhot/status/capture/left", "rhot/status/fusion/main"},
        "tablet": set(),
        "operator": set(KEYS),
    }
    may_hear = {"camera-left": {"rhot/control", "rhot/config/capture/left"}, "services": set(KEYS)}
    may_hear |= {"tablet": set(KEYS), "operator": set(KEYS)}
    async with AsyncExitStack() as stack:
        senders = {name: await opened(stack, rig, name) for name in may_put}
        listeners = {name: Listener(await opened(stack, rig, name)) for name in may_hear}
        for listener in listeners.values():
            await settled(listener.bus)
        for name, bus in senders.items():
            for key in KEYS:
                await bus.put(key, name.encode(), ENCODING)
        # Last of all, and on the same links: who has heard this has heard everything before.
        for key in ("rhot/control", "rhot/config/capture/left"):
            await senders["operator"].put(key, b"last", ENCODING)
        for listener in listeners.values():
            await until(partial(has_heard, listener.mailboxes[KEYS.index("rhot/control") + 2], 2))
        await settled(senders["operator"])
        await asyncio.sleep(0.2)  # for what must not arrive there is no condition to wait on
        for name, listener in listeners.items():
            heard = await listener.heard()
            by_sender = {sender: {key for key, payload in heard if payload == sender.encode()} for sender in may_put}
            for sender, keys in may_put.items():
                assert by_sender[sender] == keys & may_hear[name], f"{name} hears {sender}"


async def test_who_may_ask_whom(rig: Path) -> None:
    asked: list[tuple[str, bytes]] = []

    def answer(request: Request) -> Answer:
        asked.append((request.key, request.payload))
        return Answer(b"{}", "application/json")

    async with AsyncExitStack() as stack:
        services = await opened(stack, rig, "services")
        for key in ("rhot/clock", "rhot/control", "rhot/config/fusion/main"):
            services.queryable(key, answer)
        camera = await opened(stack, rig, "camera-left")
        camera.queryable("rhot/config/capture/left", answer)
        camera.queryable("rhot/clock", lambda request: Answer(b"false", "application/json"))
        operator, tablet = [await opened(stack, rig, name) for name in ("operator", "tablet")]
        assert await answers(operator, "rhot/config/capture/left")

        async def replies(bus: Bus, key: str, payload: bytes = b"") -> list[str]:
            return [reply.key for reply in await bus.get(key, payload, timeout_s=PATIENCE_S)]

        assert await replies(camera, "rhot/clock") == ["rhot/clock"] * 2, "one of them its own, inside its session"
        for key in ("rhot/config/fusion/main", "rhot/**", "rhot/status/**", "rhot/points"):
            assert [key for key in await replies(camera, key) if "config/fusion" in key] == []
        assert (await operator.get("rhot/clock"))[0].payload == b"{}", "a camera cannot pass itself off as the clock"
        assert len(await operator.get("rhot/clock")) == 1
        asked.clear()
        for key in ("rhot/config/fusion/main", "rhot/config/*/main", "rhot/**", "rhot/*/fusion/main"):
            await replies(tablet, key, b"change")
        assert all(payload == b"" for _, payload in asked), "a reader changes nothing"
        asked.clear()
        await replies(operator, "rhot/config/fusion/main", b"change")
        assert asked == [("rhot/config/fusion/main", b"change")]
        camera.alive("rhot/alive/capture/left")
        camera.alive("rhot/alive/fusion/main")
        await settled(camera)
        async with asyncio.timeout(PATIENCE_S):
            while not (alive := await tablet.who_is_alive(timeout_s=PATIENCE_S)):
                await asyncio.sleep(0.01)
        assert [reply.key for reply in alive] == ["rhot/alive/capture/left"]


def plain_session(rig: Path, tls: Mapping[str, object]) -> zenoh.Session:
    endpoints = list(as_holder(rig, "operator").connect)
    config = {
        "mode": "client",
        "connect": {"endpoints": endpoints, "timeout_ms": 0},
        "scouting": {"multicast": {"enabled": False}},
        "transport": {"link": {"tls": dict(tls)}},
    }
    return zenoh.open(zenoh.Config.from_json5(json.dumps(config)))


async def test_nobody_gets_in_without_a_certificate_of_this_rig(rig: Path, tmp_path: Path, free_port: int) -> None:
    own, foreign = rig / "keys", make_secured_rig(tmp_path / "foreign", free_port) / "keys"

    def certificate(folder: Path) -> dict[str, object]:
        pair = {"connect_certificate": folder / "operator.pem", "connect_private_key": folder / "operator.key"}
        return {"root_ca_certificate": str(own / "authority.pem"), **{name: str(file) for name, file in pair.items()}}

    for tls in (
        {"root_ca_certificate": str(own / "authority.pem")},
        {**certificate(foreign), "enable_mtls": True},
        {**certificate(own), "root_ca_certificate": str(foreign / "authority.pem"), "enable_mtls": True},
    ):
        with pytest.raises(zenoh.ZError):
            await asyncio.to_thread(plain_session, rig, tls)
    (await asyncio.to_thread(plain_session, rig, {**certificate(own), "enable_mtls": True})).close()  # type: ignore[no-untyped-call]
    in_the_clear = as_holder(rig, "operator").connect[0].replace("tls/", "tcp/")
    with pytest.raises(BusError):
        await Bus.open(BusConfig(connect=(in_the_clear,)), timeout_s=0.3)


async def test_whose_rights_were_taken_away_does_nothing_any_more(tmp_path: Path, free_port: int) -> None:
    folder = make_secured_rig(tmp_path / "rig", free_port)
    thief = tmp_path / "thief"
    thief.mkdir()
    for file in (folder / "keys").glob("camera-left.*"):
        (thief / file.name).write_bytes(file.read_bytes())
    remove_holder(folder, "camera-left")
    for file in thief.iterdir():
        (folder / "keys" / file.name).write_bytes(file.read_bytes())
    async with secured_router(folder), AsyncExitStack() as stack:
        stolen, operator = [await opened(stack, folder, name) for name in ("camera-left", "operator")]
        mailbox = operator.events("rhot/**")
        await settled(operator)
        await stolen.put("rhot/markers/left", b"stolen", ENCODING)
        await settled(stolen)
        await asyncio.sleep(0.1)
        assert mailbox.received == 0


async def test_large_samples_end_at_the_router(rig: Path) -> None:
    async with AsyncExitStack() as stack:
        operator, reader = [await opened(stack, rig, name) for name in ("operator", "tablet")]
        mailbox = reader.events("rhot/**")
        await settled(reader)
        for size in (2 << 20, 9 << 20, 1 << 20, 1):
            await operator.put("rhot/points", bytes(size), ENCODING)
        await until(lambda: mailbox.received == 2)
        assert reader.limit_counts() == {}


async def test_a_missing_certificate_says_what_to_do(rig: Path) -> None:
    with pytest.raises(ConfigError, match="rhot keys add"):
        await Bus.open(as_holder(rig, "nobody"))
