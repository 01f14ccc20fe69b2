"""The page's server before real clients: other websites, other machines, and browsers that may only look."""

from __future__ import annotations

import asyncio
import contextlib
import socket
import urllib.error
import urllib.request
from collections.abc import AsyncIterator
from pathlib import Path
from typing import Any

import msgspec
import pytest
import websockets.asyncio.server
from page.plain_client import PROTOCOL, client, look, send
from websockets.asyncio.client import connect
from websockets.exceptions import ConnectionClosed, InvalidStatus

from rhot.errors import ConfigError, DeviceError
from rhot_viewer.browser.access import Access
from rhot_viewer.browser.page import Page
from rhot_viewer.page_token import kept_token, links

TOKEN = "0123456789abcdef0123"


@pytest.fixture
async def page() -> AsyncIterator[Page]:
    opened = Page("127.0.0.1", 0)
    try:
        yield opened
    finally:
        opened.close()


@pytest.fixture
async def lan_page() -> AsyncIterator[Page]:
    """Seen by other machines; the tests come in under a name that is not this machine's loopback one."""
    opened = Page("127.0.0.1", 0, Access(TOKEN, frozenset({"desk.local"})))
    try:
        yield opened
    finally:
        opened.close()


async def status_of(attempt: connect) -> int:
    """101 when it is let in, else the status of the answer."""
    try:
        async with attempt:
            return 101
    except InvalidStatus as error:
        return int(error.response.status_code)


async def fetch(page: Page, path: str = "/", **headers: str) -> tuple[int, dict[str, str], bytes]:
    def fetched() -> tuple[int, dict[str, str], bytes]:
        request = urllib.request.Request(f"http://127.0.0.1:{page.port}{path}", headers=headers)
        try:
            with urllib.request.urlopen(request, timeout=60.0) as answer:
                return answer.status, dict(answer.headers), answer.read()
        except urllib.error.HTTPError as error:
            return error.code, dict(error.headers), error.read()

    return await asyncio.to_thread(fetched)


async def test_only_the_page_itself_may_talk_to_its_server(page: Page) -> None:
    own = f"http://127.0.0.1:{page.port}"
    assert await status_of(client(page, own)) == 101
    for origin in ("http://evil.example", "https://127.0.0.1", f"http://localhost:{page.port}", "null", None):
        assert await status_of(client(page, origin)) == 403, origin
    assert page.guard.refused["connection"] == 5


async def test_a_website_that_calls_itself_this_machine_is_refused(page: Page) -> None:
    host = f"evil.example:{page.port}"
    assert await status_of(client(page, f"http://{host}", host="evil.example")) == 403
    status, _, body = await fetch(page, Host=host)
    assert status == 403
    assert b"--allow-host" in body


async def test_no_website_may_show_the_page_in_a_frame(page: Page) -> None:
    status, headers, _ = await fetch(page)
    assert status == 200
    assert headers["X-Frame-Options"] == "DENY"
    assert headers["Content-Security-Policy"] == "frame-ancestors 'none'"
    assert headers["Referrer-Policy"] == "no-referrer"
    assert "Set-Cookie" not in headers


async def test_what_is_spelt_to_slip_through_is_judged(page: Page) -> None:
    """`Upgrade` in capitals, twice, or broken is no way around the check of the origin."""
    for upgrade in ("WebSocket", "websocket, h2c", "websocket\r\nUpgrade: websocket"):
        reader, writer = await asyncio.open_connection("127.0.0.1", page.port)
        lines = (
            "GET / HTTP/1.1",
            f"Host: 127.0.0.1:{page.port}",
            f"Upgrade: {upgrade}",
            "Connection: Upgrade",
            "Origin: http://evil.example",
            "Sec-WebSocket-Key: dGhlIHNhbXBsZSBub25jZQ==",
            "Sec-WebSocket-Version: 13",
            f"Sec-WebSocket-Protocol: {PROTOCOL}",
        )
        writer.write(("\r\n".join(lines) + "\r\n\r\n").encode())
        answer = await asyncio.wait_for(reader.readline(), 60.0)
        writer.close()
        assert b" 101 " not in answer, upgrade


async def test_a_link_with_a_token_lets_other_machines_in(lan_page: Page) -> None:
    host = f"desk.local:{lan_page.port}"
    own = f"http://{host}"
    assert (await fetch(lan_page, Host=host))[0] == 403
    assert await status_of(client(lan_page, own, host="desk.local")) == 403
    status, headers, _ = await fetch(lan_page, f"/?token={TOKEN}", Host=host)
    assert status == 200
    cookie = headers["Set-Cookie"]
    assert "HttpOnly" in cookie
    assert "SameSite=Strict" in cookie
    bare = cookie.partition(";")[0]
    assert await status_of(client(lan_page, own, host="desk.local", cookie=bare)) == 101
    assert await status_of(client(lan_page, "http://evil.example", host="desk.local", cookie=bare)) == 403
    assert (await fetch(lan_page, "/?token=wrong", Host=host))[0] == 403


async def test_a_link_writes_nothing_into_headers_but_our_tokens(lan_page: Page) -> None:
    status, headers, _ = await fetch(lan_page, "/?token=x%0d%0aSet-Cookie:%20a=b")
    assert status == 200
    assert "Set-Cookie" not in headers


async def changes_after(page: Page, token: str, *messages: tuple[str, dict[str, Any]]) -> list[Any]:
    """What a slider and a harmless button report after a browser with a token has sent messages."""
    gui = page.server.gui
    seen: list[Any] = []
    slider = gui.add_slider("exposure", 0.0, 1.0, 0.1, 0.0)
    slider.on_update(page.on_loop(lambda event: seen.append(event.target.value)))
    button, harmless = gui.add_button("restart"), gui.add_button("harmless")
    button.on_click(page.on_loop(lambda _: seen.append("restart")))
    arrived = asyncio.Event()
    harmless.on_click(page.on_loop(lambda _: arrived.set()))
    page.for_everyone(harmless)
    ids = {"slider": slider._impl.uuid, "button": button._impl.uuid, "harmless": harmless._impl.uuid}
    host = f"desk.local:{page.port}"
    async with client(page, f"http://{host}", host="desk.local", cookie=f"rhot_page_{page.port}={token}") as browser:
        await look(browser)
        async with asyncio.timeout(60.0):
            await page.looked_at()
        for kind, fields in messages:
            await send(browser, kind, **{name: ids.get(str(value), value) for name, value in fields.items()})
        await send(browser, "GuiUpdateMessage", uuid=ids["harmless"], updates={"value": True})
        async with asyncio.timeout(60.0):
            await arrived.wait()
    return seen


MOVES = (
    ("GuiUpdateMessage", {"uuid": "slider", "updates": {"value": 0.5}}),
    ("GuiUpdateMessage", {"uuid": "button", "updates": {"value": True}}),
)


async def test_one_token_changes_things_and_the_other_only_looks(lan_page: Page) -> None:
    assert await changes_after(lan_page, TOKEN, *MOVES) == [0.5, "restart"]
    assert await changes_after(lan_page, Access(TOKEN).view_token, *MOVES) == []
    assert lan_page.guard.refused["message"] == 2


async def test_nobody_publishes_the_page_on_the_internet(lan_page: Page, monkeypatch: pytest.MonkeyPatch) -> None:
    asked: list[str] = []
    monkeypatch.setattr(lan_page.server, "request_share_url", lambda *_, **__: asked.append("share"))
    assert await changes_after(lan_page, TOKEN, ("ShareUrlRequest", {})) == []
    assert asked == []
    assert lan_page.guard.refused["message"] == 1


async def test_garbage_is_dropped_and_the_browser_stays(page: Page) -> None:
    async with client(page, f"http://127.0.0.1:{page.port}") as browser:
        for data in (b"", b"\xc1", b"\x93\x01\x02\x03", msgspec.msgpack.encode({"type": ["x"]}), "text"):
            await browser.send(data)
        assert await asyncio.wait_for(browser.recv(), 60.0)
        with pytest.raises(ConnectionClosed):
            await browser.send(bytes(2 << 20))
            async with asyncio.timeout(60.0):
                while True:
                    await browser.recv()


async def test_a_viser_that_cannot_be_guarded_opens_no_page(monkeypatch: pytest.MonkeyPatch) -> None:
    """As if viser made its server by another function."""
    from viser.infra import _infra

    class Elsewhere:
        def __getattr__(self, name: str) -> Any:
            return getattr(websockets, name)

    class Asyncio:
        server = type("server", (), {"serve": staticmethod(websockets.asyncio.server.serve), "ServerConnection": None})

    stand_in = Elsewhere()
    stand_in.asyncio = Asyncio()  # type: ignore[attr-defined]
    monkeypatch.setattr(_infra, "websockets", stand_in)
    with pytest.raises(DeviceError, match="cannot be guarded"):
        Page("127.0.0.1", 0)


def test_the_token_is_kept_and_only_its_owner_reads_it(tmp_path: Path) -> None:
    file = tmp_path / "page.links"
    token = kept_token(file, 8080)
    assert len(token) >= 32
    assert kept_token(file, 8080) == token
    assert file.stat().st_mode & 0o777 == 0o600
    assert links(Access(token), socket.gethostname(), 8080)[1] in file.read_text()
    file.write_text("http://desk:8080/?token=short\n")
    with pytest.raises(ConfigError, match="holds no link with a token"):
        kept_token(file, 8080)
    with pytest.raises(ConfigError, match="cannot be written"):
        kept_token(tmp_path / "no" / "file", 8080)


def test_kept_links_follow_the_page_to_https_and_to_another_port(tmp_path: Path) -> None:
    file = tmp_path / "page.links"
    token = kept_token(file, 8080)
    # Whoever wrote another name meant it.
    file.write_text(file.read_text().replace(f"//{socket.gethostname()}", "//desk.example"))
    assert kept_token(file, 8081, "https") == token
    lines = file.read_text().splitlines()
    assert [line.partition("?")[0] for line in lines] == [
        "to look and change: https://desk.example:8081/",
        "to look: https://desk.example:8081/",
    ]
    assert [line.partition("token=")[2] for line in lines] == [token, Access(token).view_token]
    assert file.stat().st_mode & 0o777 == 0o600


@pytest.mark.parametrize("path", ["/%00", "/index.html%00", "/a%1b[2Jb", "/assets/%00.js"])
async def test_addresses_with_control_characters_are_refused(page: Page, path: str) -> None:
    status, _, body = await fetch(page, path)
    assert (status, body) == (400, b"This is no address.\n")


@pytest.mark.parametrize("data", [b"", b"\0" * 40, b"GET\r\n\r\n", b"\x16\x03\x01\x02\0" * 20, b"x" * 100_000])
async def test_what_speaks_no_http_leaves_no_traceback(
    page: Page, data: bytes, caplog: pytest.LogCaptureFixture
) -> None:
    caplog.set_level("DEBUG", "websockets.server")
    _, writer = await asyncio.open_connection("127.0.0.1", page.port)
    writer.write(data)
    with contextlib.suppress(ConnectionError):
        await writer.drain()
        writer.close()
        await writer.wait_closed()
    assert (await fetch(page))[0] == 200, "the page goes on"
    assert not [record for record in caplog.records if record.exc_info]
