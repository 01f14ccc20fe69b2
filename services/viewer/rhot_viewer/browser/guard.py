"""Access control of viser's server: checks every request by `access`, and every message of a browser.

viser (1.1) creates its server with `websockets.asyncio.server.serve` and has no hook for additional checks. While a
`ViserServer` is created, the guard replaces that function: it adds a check before viser's own
(`process_request`, https://websockets.readthedocs.io/en/stable/reference/asyncio/server.html) and a connection class
whose `recv` drops messages that the browser may not send. A viser that does not call that function would be unguarded:
`Guard.standing` is then False, and the page is not opened.
"""

from __future__ import annotations

import contextlib
import gzip
import http
import logging
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from functools import lru_cache
from http.cookies import CookieError, SimpleCookie
from typing import Any, Final
from urllib.parse import unquote

import msgspec
import websockets.asyncio.server
from websockets import Headers
from websockets.asyncio.server import ServerConnection
from websockets.http11 import Request, Response
from websockets.typing import Data

from rhot.text import printable
from rhot_viewer.browser.access import Access, PageRequest, Refusal, Role, is_websocket, token_in_link, tokens_in

# What the page is beside viser's own: its title, a panel for phones, and whether the browser wants light or dark.
#
# viser serves one HTML file, named after itself, with a panel that covers half of a phone's screen from the right. Its
# theme is the server's choice. The few lines put in front of its script here give the page its name, make the panel a
# sheet along the lower edge of narrow screens, and tell by a cookie which colours the browser's owner prefers; the
# WebSocket that follows brings the cookie along (`wants_light`).

_COOKIE: Final = "rhot_scheme"
_TITLE: Final = (b"<title>Viser</title>", b"<title>RHOT</title>")
_HEAD: Final = """<style>
@media (max-width: 36em) {
  /* viser's panel for narrow screens: fixed to the lower right corner, 20em wide. */
  .mantine-Paper-root[style*="position: fixed"][style*="bottom: 0px"] {
    left: 0; width: 100% !important; max-height: 50% !important; border-radius: 0.9em 0.9em 0 0;
    box-shadow: 0 0 1em rgba(0, 0, 0, 0.4);
  }
  .mantine-Paper-root[style*="position: fixed"] div[style*="width: 20em"] { width: 100% !important; }
}
</style>
<script>
{
  const light = matchMedia("(prefers-color-scheme: light)");
  const tell = () => {
    document.cookie = `COOKIE=${light.matches ? "light" : "dark"}; path=/; SameSite=Strict`;
  };
  tell();
  light.addEventListener("change", () => { tell(); location.reload(); });
}
</script>
</head>""".replace("COOKIE", _COOKIE).encode()


def dress(response: Response) -> None:
    """Put what is ours into viser's HTML file, in place; other files stay as they are."""
    if not response.headers.get("Content-Type", "").startswith("text/html"):
        return
    dressed = _dressed(bytes(response.body or b""), response.headers.get("Content-Encoding", "") == "gzip")
    if dressed is None:
        return
    response.body = dressed
    del response.headers["Content-Length"]
    response.headers["Content-Length"] = str(len(response.body))


@lru_cache(maxsize=2)
def _dressed(body: bytes, packed: bool) -> bytes | None:
    text = gzip.decompress(body) if packed else body
    if _TITLE[0] not in text:
        return None  # a page of our own, with a policy that allows no inline script
    text = text.replace(*_TITLE, 1).replace(b"</head>", _HEAD, 1)
    return gzip.compress(text, 6) if packed else text


def wants_light(cookies: Sequence[str]) -> bool:
    """Return whether a browser with these `Cookie` headers prefers light colours."""
    for text in cookies:
        try:
            cookie = SimpleCookie(text).get(_COOKIE)
        except CookieError:
            continue
        if cookie is not None:
            return cookie.value == "light"
    return False


logger = logging.getLogger(__name__)

_MOST_BROWSERS: Final = 32
_COOKIE_S: Final = 30 * 24 * 3600
_LOOKING: Final = frozenset({"ViewerCameraMessage"})
_CHANGING: Final = _LOOKING | {
    "CommandTriggerMessage",
    "GuiUpdateMessage",
    "SceneNodeClickMessage",
    "ScenePointerMessage",
}
"""Messages that our page sends. Others are refused, such as a request to publish the page through a server of viser's
makers (`ShareUrlRequest`)."""
_HEADERS: Final = {
    # No website may show the page in a frame and let people click what they do not see.
    "X-Frame-Options": "DENY",
    "Content-Security-Policy": "frame-ancestors 'none'",
    # The link holds a token.
    "Referrer-Policy": "no-referrer",
    "X-Content-Type-Options": "nosniff",
    "Cache-Control": "no-store",
}

Check = Callable[[ServerConnection, Request], Response | None]


class Guard:
    """Access control of one page's server.

    Attributes:
        standing: whether the server created within `standing_in` is guarded.
        refused: number of refused requests and messages by kind.
        elements: identifiers of page elements that affect only the user's own view; usable with read-only access.
    """

    def __init__(self, access: Access) -> None:
        self.standing = False
        self.refused: Counter[str] = Counter()
        self.elements: set[str] = set()
        self._access = access
        self._roles: dict[ServerConnection, Role] = {}
        self._light: set[ServerConnection] = set()

    @contextlib.contextmanager
    def standing_in(self) -> Iterator[None]:
        """Guard the server that is created within the block."""
        real = websockets.asyncio.server.serve
        guard = self

        class Connection(self.connection_kind):  # type: ignore[name-defined,misc]
            async def recv(self, decode: bool | None = None) -> Data:  # viser's only call
                while True:
                    data: Data = await super().recv(decode)
                    if guard.admits(self, data):
                        return data

        def serve(*arguments: Any, process_request: Check | None = None, **options: Any) -> Any:
            def check(connection: ServerConnection, request: Request) -> Response | None:
                return self.check(connection, request, process_request)

            # Largest message from a browser; clicks and sliders send some hundred bytes. viser's own
            # limit is 50 MB.
            options |= {
                "process_request": check,
                "create_connection": Connection,
                "max_size": (1 << 20),
                "logger": _quiet_logger(),
            }
            self.standing = True
            return real(*arguments, **options)

        websockets.asyncio.server.serve = serve  # type: ignore[assignment,misc]
        try:
            yield
        finally:
            websockets.asyncio.server.serve = real  # type: ignore[misc]

    @property
    def connection_kind(self) -> type[ServerConnection]:
        """Connection class of a server with this guard; removes a connection from the guard when it ends."""
        guard = self

        class Connection(ServerConnection):
            def connection_lost(self, exc: Exception | None) -> None:
                guard.forget(self)
                super().connection_lost(exc)

        return Connection

    def role_of(self, connection: ServerConnection) -> Role:
        """Return the role of a connected browser."""
        return self._roles.get(connection, "view")

    def is_light(self, connection: ServerConnection) -> bool:
        """Return whether a connected browser prefers light colours."""
        return connection in self._light

    def forget(self, connection: ServerConnection) -> None:
        """Drop a connection that has ended."""
        self._roles.pop(connection, None)
        self._light.discard(connection)

    def admits(self, connection: ServerConnection, data: Data) -> bool:
        """Return whether a browser may send a message."""
        try:
            message = msgspec.msgpack.decode(data) if isinstance(data, bytes) else None
        except msgspec.MsgspecError:
            message = None
        kind = message.get("type") if isinstance(message, dict) else None
        if kind in (_CHANGING if self.role_of(connection) == "control" else _LOOKING):
            return True
        if kind == "GuiUpdateMessage" and isinstance(message, dict) and message.get("uuid") in self.elements:
            return True
        self._count("message")
        return False

    def check(self, connection: ServerConnection, request: Request, server: Check | None) -> Response | None:
        """Check a request, for `process_request` of websockets; None accepts a WebSocket.

        Args:
            connection: the connection.
            request: the request.
            server: answers requests for files, and returns None for a WebSocket.
        """
        port = connection.local_address[1]
        cookie = f"rhot_page_{port}"
        headers = request.headers
        asked = PageRequest(
            peer=str(connection.remote_address[0]),
            host=_only(headers, "Host"),
            origin=_only(headers, "Origin"),
            is_websocket=is_websocket(headers),
            tokens=tokens_in(request.path, headers.get_all("Cookie"), cookie),
        )
        if not _is_clean(request.path.partition("?")[0]):
            self._count("page")
            return _answer(http.HTTPStatus.BAD_REQUEST, "This is no address.")
        role = self._access.judge(asked)
        if isinstance(role, Refusal):
            self._log_refusal(asked, role)
            return _answer(http.HTTPStatus.FORBIDDEN, role.reason)
        response = server(connection, request) if server is not None else None
        if response is None:
            if not asked.is_websocket:
                return _answer(http.HTTPStatus.NOT_FOUND, "There is nothing here.")
            if len(self._roles) >= _MOST_BROWSERS:
                self._count("connection")
                return _answer(http.HTTPStatus.SERVICE_UNAVAILABLE, f"{_MOST_BROWSERS} browsers look already.")
            self._roles[connection] = role
            if wants_light(headers.get_all("Cookie")):
                self._light.add(connection)
            return None
        dress(response)
        for name, value in _HEADERS.items():
            response.headers[name] = value
        token = token_in_link(request.path)
        if self._access.knows(token):
            secure = "; Secure" if connection.transport.get_extra_info("ssl_object") is not None else ""
            response.headers["Set-Cookie"] = (
                f"{cookie}={token}; Path=/; Max-Age={_COOKIE_S}; HttpOnly; SameSite=Strict{secure}"
            )
        return response

    def _log_refusal(self, asked: PageRequest, refusal: Refusal) -> None:
        kind = "connection" if asked.is_websocket else "page"
        if not self.refused[kind]:
            # Only the first of its kind is logged; the status has the number.
            logger.warning(
                "refused %s from %s (Host %s, Origin %s): %s",
                f"a {kind}",
                asked.peer,
                printable(asked.host, 100) or "missing",
                printable(asked.origin, 100) or "missing",
                refusal.reason,
            )
        self._count(kind)

    def _count(self, kind: str) -> None:
        self.refused[kind] += 1


def _quiet_logger() -> logging.Logger:
    """Return the logger of the server: every connection that speaks no HTTP would leave a traceback in it."""
    quiet = logging.getLogger(f"{__name__}.connections")
    quiet.setLevel(logging.CRITICAL)
    return quiet


def _is_clean(path: str) -> bool:
    """Return whether a path names something: no file's name holds control characters, and NUL ends in an error."""
    return all(character.isprintable() for character in unquote(path))


def _only(headers: Headers, name: str) -> str:
    values = headers.get_all(name)
    return values[0] if len(values) == 1 else ""


def _answer(status: http.HTTPStatus, text: str) -> Response:
    body = f"{text}\n".encode()
    headers = Headers(_HEADERS)
    headers["Content-Type"] = "text/plain; charset=utf-8"
    headers["Content-Length"] = str(len(body))
    return Response(status.value, status.phrase, headers, body)
