"""The web page's server, and the connected browsers.

viser serves page, script and data from one process and one port, without other servers, and its client reconnects by
itself. Its callbacks run on its own threads; `Page.on_loop` moves them to our event loop.
"""

from __future__ import annotations

import asyncio
import contextlib
import functools
import io
import logging
import socket
import threading
import time
from collections.abc import Callable
from typing import Any, Final, TypeVar

import viser
from viser.infra._async_message_buffer import AsyncMessageBuffer
from viser.infra._messages import Message

from rhot.errors import DeviceError
from rhot_viewer.browser.access import Access, cannot_listen, page_address
from rhot_viewer.browser.guard import Guard

# A fault of viser, mended: its senders are woken from whatever thread changes the page.
#
# `asyncio.Event.set` goes through those who wait, and belongs to the event loop's thread ("Not thread-safe" in Python's
# documentation). viser 1.1 calls it in ours, too, so that it fails with "deque mutated during iteration" when a sender
# begins or ends to wait at that moment. By then the message is in its queue; only the senders are still to be woken.


def wake_senders_safely() -> None:
    """Make each page of this process wake viser's senders on their own thread when that failed on ours."""
    real = AsyncMessageBuffer.push
    if hasattr(real, "__wrapped__"):
        return

    @functools.wraps(real)
    def push(self: AsyncMessageBuffer, message: Message) -> None:
        try:
            real(self, message)
        except RuntimeError as error:
            if "mutated during iteration" not in str(error):
                raise
            # Cleared first: an event that counts as set wakes nobody.
            self.event_loop.call_soon_threadsafe(_wake, self)

    AsyncMessageBuffer.push = push  # type: ignore[method-assign]


def _wake(buffer: AsyncMessageBuffer) -> None:
    buffer.message_event.clear()
    buffer.message_event.set()


logger = logging.getLogger(__name__)

_CLOSE_LIMIT_S: Final = 0.4
PANEL_WIDTH_PX: Final = 420
"""Wide enough for a table of services, and leaves most of a tablet (1024 px) to the scene."""
_LOOKING_ONLY: Final = "Sliders and buttons have no effect here. Flying around and looking through cameras work."

E = TypeVar("E")


class Page:
    """One page for any number of browsers.

    Attributes:
        server: viser's server: `scene` for 3D, `gui` for the panel.
        guard: access control of the server.
        url: address of the page on this machine.
        port: of the page.
    """

    def __init__(self, host: str, port: int, access: Access | None = None) -> None:
        """Open the page; to be called on the event loop that updates it.

        Args:
            host: address to listen on.
            port: to listen on; 0 for any.
            access: access rules; by default only this machine has access.

        Raises:
            DeviceError: the port is taken, the address is not this machine's, or viser cannot be guarded.
        """
        self._loop = asyncio.get_running_loop()
        self._browsers: set[int] = set()
        self._looked_at = asyncio.Event()
        self._alone = asyncio.Event()
        self._alone.set()
        _check_free(host, port)
        wake_senders_safely()
        self.guard = Guard(access or Access())
        with _quiet(), self.guard.standing_in():
            self.server = viser.ViserServer(host=host, port=port, label="RHOT", verbose=False)
        if not self.guard.standing:
            self.close()
            raise DeviceError(
                f"viser {viser.__version__} opens its server in a way that cannot be guarded against other websites; "
                "install the version that is tested: pip install 'viser<1.2'"
            )
        found = self.server.get_port()
        if port not in (0, found):
            # viser silently uses the next free port, where users would not find the page.
            self.close()
            raise DeviceError(cannot_listen(host, port))
        self.url = page_address(host, found)
        self.port = found
        self.set_theme(self.server.gui, light=False)
        self.server.gui.main_panel.dock_right()
        self.server.gui.main_panel.set_width(PANEL_WIDTH_PX)
        self.server.on_client_connect(self._greet)
        self.server.on_client_disconnect(lambda client: self._soon(self._left, client.client_id))

    @staticmethod
    def set_theme(gui: viser.GuiApi, *, light: bool) -> None:
        """Choose the colours of all browsers (the server's `gui`) or of one (a client's)."""
        # No share button: it would offer the page to the internet through a server of viser's makers.
        brand_rgb = (30, 110, 160)
        gui.configure_theme(
            dark_mode=not light, show_logo=False, show_share_button=False, brand_color=brand_rgb, control_width="large"
        )

    def _greet(self, client: viser.ClientHandle) -> None:
        connection = self.server._websock_server._live_connections.get(client.client_id)
        if connection is not None and self.guard.is_light(connection):
            self.set_theme(client.gui, light=True)
        if connection is not None and self.guard.role_of(connection) == "view":
            client.add_notification(title="Looking only", body=_LOOKING_ONLY, with_close_button=True)
        self._soon(self._came, client.client_id)

    def for_everyone(self, element: viser.GuiButtonHandle) -> None:
        """Enable a button that affects only the user's own view for browsers with read-only access."""
        self.guard.elements.add(element._impl.uuid)

    def _came(self, browser: int) -> None:
        self._browsers.add(browser)
        self._looked_at.set()
        self._alone.clear()
        logger.info("browser %d connected, %d in all", browser, len(self._browsers))

    def _left(self, browser: int) -> None:
        self._browsers.discard(browser)
        if not self._browsers:
            self._looked_at.clear()
            self._alone.set()
        logger.info("browser %d left, %d remain", browser, len(self._browsers))

    @property
    def browsers(self) -> int:
        """Number of connected browsers."""
        return len(self._browsers)

    async def looked_at(self) -> None:
        """Return once a browser is connected."""
        await self._looked_at.wait()

    async def left(self) -> None:
        """Return once no browser is connected."""
        await self._alone.wait()

    def on_loop(self, work: Callable[[E], None]) -> Callable[[E], None]:
        """Return a callback for viser that runs `work` on our event loop."""
        return lambda event: self._soon(work, event)

    def with_moment(self, work: Callable[[E, int], None]) -> Callable[[E], None]:
        """Return such a callback for work that wants to know when the browser's message was here.

        It gets the system clock's nanoseconds, read before it waits for our event loop, which may be drawing.
        """
        return lambda event: self._soon(work, event, time.time_ns())

    def _soon(self, work: Callable[..., None], *arguments: Any) -> None:
        with contextlib.suppress(RuntimeError):  # the loop is closed: the process is ending
            self._loop.call_soon_threadsafe(work, *arguments)

    def close(self) -> None:
        """Close the page; browsers show that they are disconnected.

        viser waits up to six seconds for the closing handshakes of browsers. This method waits for `_CLOSE_LIMIT_S`
        only; the rest ends with the process.
        """
        closing = threading.Thread(target=self.server.stop, name="close page", daemon=True)
        with _quiet():
            closing.start()
            closing.join(_CLOSE_LIMIT_S)


def _quiet() -> contextlib.redirect_stdout[io.StringIO]:
    """Suppress viser's output, because `rhot up` shares the terminal."""
    return contextlib.redirect_stdout(io.StringIO())


def _check_free(host: str, port: int) -> None:
    try:
        family, kind, protocol, _, address = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM)[0]
        with socket.socket(family, kind, protocol) as probe:
            probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            probe.bind(address)
    except (OSError, UnicodeError) as error:  # UnicodeError: not a valid host name
        raise DeviceError(cannot_listen(host, port, error)) from error
