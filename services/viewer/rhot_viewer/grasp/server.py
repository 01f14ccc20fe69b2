"""The server of the page *Grasp*: its files, and one WebSocket per browser that sends the newest samples."""

from __future__ import annotations

import asyncio
import contextlib
import logging
import ssl
from collections.abc import Callable
from pathlib import Path
from typing import Any, Final

from websockets.asyncio.server import Server, ServerConnection, serve
from websockets.exceptions import ConnectionClosed, WebSocketException
from websockets.http11 import Request, Response

from rhot.errors import ConfigError, DeviceError, WireError
from rhot.keys import ROUTER, certificate_file, key_file
from rhot.rig import BusConfig
from rhot_viewer.browser.access import Role, cannot_listen, is_websocket
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
    """One connected browser.

    Attributes:
        role: its access rights.
        pace: rate control of the frames sent to it.
        wished_hz: most frames per second that it requested.
        wants_truth: whether it shows the ground truth.
        shown: its latest drawing figures; None before the first.
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
        """Wake `feed`: there are new samples, or the browser has received a frame."""
        self._something.set()

    async def send(self, text: str) -> None:
        """Send one message."""
        await self._connection.send(text, text=True)

    async def feed(self, newest: Newest) -> None:
        """Send new samples until cancelled or disconnected."""
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
        browsers: connected browsers.
        rate_hz: most frames per second for each browser.
        audience_changed: set whenever a browser connects, disconnects or changes its preferences.
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
        """Create the server; `open` starts it.

        Args:
            guard: access control.
            newest: the samples to send.
            hello: returns the first message for a role.
            now_ms: returns the rig time, milliseconds; NaN while unknown.
            heard: called with messages of a browser that do not concern its own frames.
            gone: called when a browser has disconnected.
            meshes: returns an object's surface, glTF, by the object's name.
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
        """Start listening, and return the port.

        Raises:
            DeviceError: the port is in use, or the address is not this machine's.
        """
        socket_logger = logging.getLogger(_SOCKET_LOGGER)
        socket_logger.setLevel(logging.ERROR)
        socket_logger.addFilter(_is_no_lost_connection)
        try:
            self._server = await serve(
                self._stay,
                host,
                port,
                ssl=tls,
                process_request=self._request,
                # Also removes connections whose handshake fails after the check, which never reach `_stay`.
                create_connection=self._guard.connection_kind,
                # Compressing small texts at 90 Hz costs more time than it saves.
                compression=None,
                max_size=MOST_BYTES,
                logger=socket_logger,
            )
        except (OSError, UnicodeError) as error:  # UnicodeError: no name can be like this
            raise DeviceError(cannot_listen(host, port, error)) from error
        return int(next(iter(self._server.sockets)).getsockname()[1])

    def wake(self) -> None:
        """Wake all browsers' `feed`: there are new samples."""
        for browser in self.browsers:
            browser.wake()

    def limit(self, rate_hz: float) -> None:
        """Limit the frames per second of every browser."""
        self.rate_hz = rate_hz
        for browser in self.browsers:
            browser.pace.rate_hz = min(browser.wished_hz, rate_hz)

    async def send_hello(self) -> None:
        """Send the first message to every browser again, because the rig has changed."""
        for browser in list(self.browsers):
            with contextlib.suppress(ConnectionClosed):
                await browser.send(self._hello(browser.role))

    def _request(self, connection: ServerConnection, request: Request) -> Response | None:
        def file(_: ServerConnection, asked: Request) -> Response | None:
            return None if is_websocket(asked.headers) else files.answer(asked, self._meshes)

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
        """Close all connections and stop listening."""
        if self._server is not None:
            self._server.close()
            with contextlib.suppress(TimeoutError):
                await asyncio.wait_for(self._server.wait_closed(), 0.5)


def _is_no_lost_connection(record: logging.LogRecord) -> bool:
    """Tell whether a message of websockets is more than that a browser went away or was too slow."""
    return not (record.exc_info and isinstance(record.exc_info[1], WebSocketException))


def _number(value: float) -> str:
    return f"{value:.4f}" if value == value else "null"  # noqa: PLR0124  # NaN


def page_tls(bus: BusConfig) -> ssl.SSLContext | None:
    """Return the TLS context for HTTPS with the rig's certificate; None if the rig has none.

    Raises:
        ConfigError: the certificate or its key cannot be read.
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
