"""The page's server: who may look, who may publish, what it serves; by a real WebSocket."""

from __future__ import annotations

import asyncio
import json
import ssl
import urllib.error
import urllib.request
from collections.abc import AsyncIterator
from pathlib import Path
from typing import Any

import pytest
from websockets.asyncio.client import ClientConnection, connect
from websockets.exceptions import InvalidStatus
from websockets.typing import Origin

from rhot.errors import ConfigError, DeviceError
from rhot.rig import BusConfig
from rhot_tools.keys.making import make_keys
from rhot_viewer.browser.access import Access, Role
from rhot_viewer.browser.guard import Guard
from rhot_viewer.grasp import files
from rhot_viewer.grasp.newest import Newest
from rhot_viewer.grasp.server import Browser, GraspServer, page_tls

TOKEN = "a-token-that-is-long-enough"
DEVICES = {"type": "devices", "t_ms": 1.7e12, "head": {"position": [0, 1, 0], "orientation": [0, 0, 0, 1]}}
LIMIT_S = 20.0
LARGE = bytes(16_000_000)
"""More than the system buffers between two of its processes."""


class Page:
    """A server that stands alone.

    Attributes:
        heard: what browsers told that concerns the rig.
    """

    def __init__(self, access: Access) -> None:
        self.guard = Guard(access)
        self.newest = Newest()
        self.heard: list[Any] = []
        self.left: list[Browser] = []
        self.port = 0
        self.server = GraspServer(
            self.guard,
            self.newest,
            self.hello,
            lambda: 1234.5,
            lambda _, told: self.heard.append(told),
            self.left.append,
            {"cup": b"glTF", "large": LARGE}.get,
        )

    def hello(self, role: Role) -> str:
        return json.dumps({"type": "hello", "role": role})

    def put(self, key: str, text: str) -> None:
        self.newest.put(key, text)
        self.server.wake()


@pytest.fixture
async def page() -> AsyncIterator[Page]:
    """For this machine, and with a token for others."""
    made = Page(Access(TOKEN, frozenset({"desk.local"})))
    made.port = await made.server.open("127.0.0.1", 0, None)
    try:
        yield made
    finally:
        await made.server.close()


def browser(page: Page, *, host: str = "", origin: str | None = "", token: str = "") -> connect:
    name = host or "127.0.0.1"
    return connect(
        f"ws://{name}:{page.port}/{f'?token={token}' if token else ''}",
        origin=(f"http://{name}:{page.port}" if origin == "" else origin),  # type: ignore[arg-type]
        host="127.0.0.1",
        port=page.port,
        open_timeout=LIMIT_S,
    )


async def read(connection: ClientConnection) -> Any:
    return json.loads(await asyncio.wait_for(connection.recv(), LIMIT_S))


async def tell(connection: ClientConnection, **message: Any) -> None:
    await connection.send(json.dumps(message))


async def answered(connection: ClientConnection) -> None:
    """Return when all that was told before has been heard."""
    await tell(connection, type="time", at_ms=7.25)
    while (message := await read(connection))["type"] != "time":
        pass
    assert message == {"type": "time", "at_ms": 7.25, "rig_ms": 1234.5}


async def test_the_newest_wins_and_waits_until_the_last_were_taken(page: Page) -> None:
    async with browser(page) as one:
        assert await read(one) == {"type": "hello", "role": "control"}
        seen: list[int] = []
        for number in range(50):
            page.put("rhot/hand/right", str(number))
            await asyncio.sleep(0.002)
        while not seen or seen[-1] < 49:
            seen.append((await read(one))["keys"]["rhot/hand/right"])
            await tell(one, type="taken")
        assert seen == sorted(seen)
        assert len(seen) <= 5, "what was not taken was replaced, not kept"


async def test_handshakes_that_fail_take_no_browsers_place(page: Page) -> None:
    address = f"127.0.0.1:{page.port}"
    for _ in range(40):
        reader, writer = await asyncio.open_connection("127.0.0.1", page.port)
        # Let in by its address and origin; then the key is missing, without which it is no WebSocket.
        lines = ("GET / HTTP/1.1", f"Host: {address}", f"Origin: http://{address}", "Connection: Upgrade")
        writer.write("\r\n".join((*lines, "Upgrade: websocket", "", "")).encode())
        assert b"400 Bad Request" in await asyncio.wait_for(reader.readline(), LIMIT_S)
        writer.close()
        await writer.wait_closed()
    async with browser(page) as one:
        assert (await read(one))["role"] == "control"


async def test_the_truth_is_sent_to_who_asks_for_it(page: Page) -> None:
    async with browser(page) as one, browser(page) as other:
        for each in (one, other):
            await read(each)
        await tell(one, type="wish", truth=True)
        await answered(one)
        page.put("rhot/truth", "1")
        page.put("rhot/hand/right", "2")
        assert await keys_of(one, "rhot/truth", "rhot/hand/right") == {"rhot/truth", "rhot/hand/right"}
        assert await keys_of(other, "rhot/hand/right") == {"rhot/hand/right"}


async def keys_of(connection: ClientConnection, *wanted: str) -> set[str]:
    found: set[str] = set()
    while not found.issuperset(wanted):
        found |= (await read(connection))["keys"].keys()
        await tell(connection, type="taken")
    return found


async def test_a_headset_is_heard_from_who_may_change_things(page: Page) -> None:
    async with browser(page, host="desk.local", token=TOKEN) as one:
        assert (await read(one))["role"] == "control"
        await tell(one, **DEVICES)
        await answered(one)
    assert len(page.heard) == 1


async def test_whoever_looks_tells_what_it_has_drawn(page: Page) -> None:
    async with browser(page, host="desk.local", token=Access(TOKEN).view_token) as one:
        await tell(one, type="shown", pictures_hz=60.0, waits_ms=[4.5], clock_ms=0.2, graphics=True)
        await answered(one)
        assert [told.waits_ms for told in page.heard] == [[4.5]]
        (here,) = page.server.browsers
        assert here.shown is page.heard[0]
    assert page.guard.refused["message"] == 0


async def test_who_only_looks_publishes_nothing(page: Page) -> None:
    async with browser(page, host="desk.local", token=Access(TOKEN).view_token) as one:
        assert (await read(one))["role"] == "view"
        await tell(one, **DEVICES)
        await tell(one, type="moved")
        await one.send(b"\xff\x00")
        await one.send("{")
        await answered(one)
    assert page.heard == []
    assert page.guard.refused["message"] == 4


@pytest.mark.parametrize(
    ("host", "origin", "token"),
    [
        ("", "http://evil.example", ""),
        ("", None, ""),
        ("evil.example", "", ""),
        ("desk.local", "", ""),
        ("desk.local", "", "wrong"),
    ],
)
async def test_websites_and_strangers_are_refused(page: Page, host: str, origin: str | None, token: str) -> None:
    with pytest.raises(InvalidStatus) as refusal:
        async with browser(page, host=host, origin=origin, token=token):
            pass
    assert refusal.value.response.status_code == 403
    assert page.server.browsers == set()


async def fetch(page: Page, path: str, scheme: str = "http", tls: ssl.SSLContext | None = None) -> tuple[int, bytes]:
    def fetched() -> tuple[int, bytes]:
        try:
            with urllib.request.urlopen(
                f"{scheme}://127.0.0.1:{page.port}{path}", timeout=LIMIT_S, context=tls
            ) as answer:
                assert answer.headers["X-Frame-Options"] == "DENY"
                assert "default-src 'self'" in (answer.headers.get_all("Content-Security-Policy") or [""])[0]
                return answer.status, answer.read()
        except urllib.error.HTTPError as error:
            return error.code, error.read()

    return await asyncio.to_thread(fetched)


async def test_files_of_the_bundle_and_no_others(page: Page, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    bundle = tmp_path / "static"
    bundle.mkdir()
    (tmp_path / "secret.js").write_text("secret")
    monkeypatch.setattr(files, "BUNDLE", bundle)
    status, body = await fetch(page, "/")
    assert status == 200
    assert b"make web" in body, "says what to do while the page is not built"
    (bundle / "index.html").write_text("<!doctype html>the page")
    (bundle / "grasp.js").write_text("1")
    assert await fetch(page, "/?token=x") == (200, b"<!doctype html>the page")
    assert await fetch(page, "/grasp.js") == (200, b"1")
    assert await fetch(page, "/mesh.cup.glb") == (200, b"glTF"), "the surface of an object"
    for path in (
        "/../secret.js",
        "/%2e%2e/secret.js",
        "/..%2fsecret.js",
        "/none.js",
        "/mesh.pot.glb",
        "/grasp.js/",
        "/.grasp.js",
        "//etc/passwd",
    ):
        assert (await fetch(page, path))[0] == 404, path


async def test_a_file_reaches_a_slow_browser_whole(page: Page, caplog: pytest.LogCaptureFixture) -> None:
    async def asked() -> tuple[asyncio.StreamReader, asyncio.StreamWriter]:
        reader, writer = await asyncio.open_connection("127.0.0.1", page.port)
        writer.write(f"GET /mesh.large.glb HTTP/1.1\r\nHost: 127.0.0.1:{page.port}\r\n\r\n".encode())
        assert await reader.readline() == b"HTTP/1.1 200 OK\r\n"
        return reader, writer

    slow, slows = await asked()
    _, leaves = await asked()
    await asyncio.sleep(1.0)
    leaves.transport.abort()
    assert (await asyncio.wait_for(slow.read(), LIMIT_S)).endswith(LARGE)
    slows.close()
    await answers_others(page)
    assert caplog.records == []


async def answers_others(page: Page) -> None:
    async with browser(page) as one:
        assert (await read(one))["type"] == "hello"


async def test_a_taken_port_is_named(page: Page) -> None:
    other = Page(Access())
    with pytest.raises(DeviceError, match=f"port {page.port}"):
        await other.server.open("127.0.0.1", page.port, None)


async def test_a_headset_is_served_over_https_with_the_rigs_certificates(rig_folder: Path) -> None:
    bus = BusConfig(keys=str(rig_folder / "keys"))
    assert page_tls(bus) is None, "no keys, no https"
    make_keys(rig_folder, ["127.0.0.1"])
    made = Page(Access(TOKEN))
    made.port = await made.server.open("127.0.0.1", 0, page_tls(bus))
    try:
        trusting = ssl.create_default_context(cafile=rig_folder / "keys" / "authority.pem")
        trusting.verify_flags |= ssl.VERIFY_X509_STRICT  # the default from Python 3.13 on
        status, _ = await fetch(made, f"/?token={TOKEN}", "https", trusting)
        assert status == 200
        own = Origin(f"https://127.0.0.1:{made.port}")
        async with connect(f"wss://127.0.0.1:{made.port}/", origin=own, ssl=trusting) as one:
            assert (await read(one))["type"] == "hello"
    finally:
        await made.server.close()
    (rig_folder / "keys" / "router.key").write_text("no key")
    with pytest.raises(ConfigError, match="rhot keys make"):
        page_tls(bus)
