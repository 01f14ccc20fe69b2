"""The server of the page *Grasp*: its files, and one WebSocket a browser, on which the newest wins."""

from __future__ import annotations

import asyncio
import contextlib
import logging
import ssl
from collections.abc import Callable
from pathlib import Path
from typing import Any, Final

from websockets.asyncio.server import Server, ServerConnection, serve
from websockets.exceptions import ConnectionClosed
from websockets.http11 import Request, Response

from rhot.errors import ConfigError, DeviceError, WireError
from rhot.keys.folder import certificate_file, key_file
from rhot.keys.roles import ROUTER
from rhot.rig import BusConfig
from rhot_viewer.browser.access import Role
from rhot_viewer.browser.guard import Guard
from rhot_viewer.grasp import files
from rhot_viewer.grasp.newest import Newest, Pace
from rhot_viewer.grasp.uplink import (
    MOST_BYTES,
    ClockQuestion,
    DrawingFigures,
    FrameReceived,
    Preferences,
    parse_message,
)

logger = logging.getLogger(__name__)
_SOCKET_LOGGER: Final = "rhot_viewer.websockets"
_TRUTH: Final = "rhot/truth"


class Browser:
    """One browser.

    Attributes:
        role: what it may do.
        pace: of what it is sent.
        wished_hz: most frames per second that it asked for.
        wants_truth: whether it shows the truth.
        shown: what it drew last; None until it has said so.
    """

    def __init__(self, connection: ServerConnection, role: Role) -> None:
        self.role = role
        self.pace = Pace()
        self.wished_hz = self.pace.rate_hz
        self.wants_truth = False
        self.shown: DrawingFigures | None = None
        self._connection = connection
        self._something = asyncio.Event()

    def wake(self) -> None:
        """Something is new, or the last frame was taken."""
        self._something.set()

    async def send(self, text: str) -> None:
        """Send one message."""
        await self._connection.send(text, text=True)

    async def feed(self, newest: Newest) -> None:
        """Send what is new until cancelled or gone."""
        loop = asyncio.get_running_loop()
        while True:
            await self._something.wait()
            self._something.clear()
            wait_s = self.pace.wait_s(loop.time())
            if wait_s is None:
                continue
            await asyncio.sleep(wait_s)
            text = newest.since(self.pace.version, () if self.wants_truth else (_TRUTH,))
            if text:
                self.pace.sent(loop.time(), newest.version)
                await self.send(text)


class GraspServer:
    """Serves the page to any number of browsers.

    Attributes:
        browsers: who looks.
        rate_hz: most frames per second for each.
        audience_changed: set whenever a browser comes, goes, or wishes for something else.
    """

    def __init__(
        self,
        guard: Guard,
        newest: Newest,
        hello: Callable[[Role], str],
        now_ms: Callable[[], float],
        heard: Callable[[Browser, Any], None],
        gone: Callable[[Browser], None],
        meshes: Callable[[str], bytes | None],
    ) -> None:
        """Prepare.

        Args:
            guard: before it.
            newest: what is sent.
            hello: the first message to whoever may do so much.
            now_ms: rig clock; NaN while it is not known.
            heard: called with what a browser tells beyond what concerns its own frames.
            gone: called when a browser has left.
            meshes: the surface of an object, glTF, by its name.
        """
        self.browsers: set[Browser] = set()
        self.rate_hz = 120.0
        self.audience_changed = asyncio.Event()
        self._guard = guard
        self._newest = newest
        self._hello = hello
        self._now_ms = now_ms
        self._heard = heard
        self._gone = gone
        self._meshes = meshes
        self._server: Server | None = None

    async def open(self, host: str, port: int, tls: ssl.SSLContext | None) -> int:
        """Listen, and return the port.

        Raises:
            DeviceError: the port or the address cannot be had.
        """
        logging.getLogger(_SOCKET_LOGGER).setLevel(logging.ERROR)
        try:
            self._server = await serve(
                self._stay,
                host,
                port,
                ssl=tls,
                process_request=self._request,
                # A handshake that fails after it was let in never comes to `_stay`.
                create_connection=self._guard.connection_kind,
                # Small texts at 90 Hz: packing them costs more time than it saves.
                compression=None,
                max_size=MOST_BYTES,
                close_timeout=0.3,
                logger=logging.getLogger(_SOCKET_LOGGER),
            )
        except (OSError, UnicodeError) as error:  # UnicodeError: no name can be like this
            raise DeviceError(
                f"the page cannot be opened on {host} port {port}: another program, perhaps another viewer, has it, or "
                f"the address is not this machine's; choose another with --port or --host "
                f"({getattr(error, 'strerror', None) or error})"
            ) from error
        return int(next(iter(self._server.sockets)).getsockname()[1])

    def wake(self) -> None:
        """Something is new."""
        for browser in self.browsers:
            browser.wake()

    def limit(self, rate_hz: float) -> None:
        """Send no browser more frames per second than this."""
        self.rate_hz = rate_hz
        for browser in self.browsers:
            browser.pace.rate_hz = min(browser.wished_hz, rate_hz)

    async def send_hello(self) -> None:
        """Send every browser the first message again: the rig has changed."""
        for browser in list(self.browsers):
            with contextlib.suppress(ConnectionClosed):
                await browser.send(self._hello(browser.role))

    def _request(self, connection: ServerConnection, request: Request) -> Response | None:
        def file(_: ServerConnection, asked: Request) -> Response | None:
            is_websocket = bool(asked.headers.get_all("Upgrade") or asked.headers.get_all("Sec-WebSocket-Key"))
            return None if is_websocket else files.answer(asked, self._meshes)

        return self._guard.check(connection, request, file)

    async def _stay(self, connection: ServerConnection) -> None:
        browser = Browser(connection, self._guard.role_of(connection))
        self.browsers.add(browser)
        self.audience_changed.set()
        logger.info("a browser has connected, %d now", len(self.browsers))
        feeding: asyncio.Task[None] | None = None
        try:
            await browser.send(self._hello(browser.role))
            feeding = asyncio.create_task(browser.feed(self._newest))
            browser.wake()
            async for text in connection:
                await self._receive(browser, text)
        except ConnectionClosed:
            pass
        finally:
            self.browsers.discard(browser)
            self.audience_changed.set()
            self._gone(browser)
            logger.info("a browser has gone, %d left", len(self.browsers))
            if feeding is not None:
                feeding.cancel()
                await asyncio.gather(feeding, return_exceptions=True)

    async def _receive(self, browser: Browser, text: str | bytes) -> None:
        try:
            message = parse_message(text)
        except WireError:
            self._guard.refused["message"] += 1
            return
        if isinstance(message, FrameReceived):
            browser.pace.taken()
            browser.wake()
        elif isinstance(message, Preferences):
            browser.wished_hz, browser.wants_truth = message.rate_hz, message.truth
            self.audience_changed.set()
            browser.pace.rate_hz, browser.pace.ahead = min(message.rate_hz, self.rate_hz), message.ahead
        elif isinstance(message, DrawingFigures):
            browser.shown = message
            self._heard(browser, message)
        elif isinstance(message, ClockQuestion):
            await browser.send(f'{{"type":"time","at_ms":{message.at_ms!r},"rig_ms":{_number(self._now_ms())}}}')
        elif browser.role != "control":
            self._guard.refused["message"] += 1
        else:
            self._heard(browser, message)

    async def close(self) -> None:
        """Say goodbye to all and stop listening."""
        if self._server is not None:
            self._server.close()
            with contextlib.suppress(TimeoutError):
                await asyncio.wait_for(self._server.wait_closed(), 0.5)


def _number(value: float) -> str:
    return f"{value:.4f}" if value == value else "null"  # noqa: PLR0124  # NaN


def page_tls(bus: BusConfig) -> ssl.SSLContext | None:
    """Return what the page is served with over HTTPS: the rig's own certificate; None where there is none.

    Raises:
        ConfigError: it cannot be read.
    """
    folder = Path(bus.keys)
    certificate, key = certificate_file(folder, ROUTER), key_file(folder, ROUTER)
    if not certificate.exists():
        return None
    context = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER)
    try:
        context.load_cert_chain(certificate, key)
    except (OSError, ssl.SSLError) as error:
        raise ConfigError(f"{key}: cannot be used for https: {error}; `rhot keys make` makes it") from error
    return context
