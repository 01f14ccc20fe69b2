"""A client of the page without a browser: it sends what the page's script would."""

from __future__ import annotations

from typing import Any

import msgspec
import viser
from websockets.asyncio.client import ClientConnection, connect

from rhot_viewer.browser.page import Page

PROTOCOL = f"viser-v{viser.__version__}"


def client(page: Page, origin: str | None, *, host: str = "", cookie: str = "", path: str = "/") -> connect:
    """A WebSocket client that says what a browser would say; `host` as the browser was told it."""
    headers = {"Cookie": cookie} if cookie else {}
    # The address is given apart, so that the Host header can be another machine's view of this one.
    return connect(
        f"ws://{host or '127.0.0.1'}:{page.port}{path}",
        origin=origin,  # type: ignore[arg-type]
        additional_headers=headers,
        subprotocols=[PROTOCOL],  # type: ignore[list-item]
        host="127.0.0.1",
        port=page.port,
        max_size=None,
        open_timeout=60.0,
    )


async def send(connection: ClientConnection, kind: str, **fields: Any) -> None:
    """Send a message of viser's."""
    await connection.send(msgspec.msgpack.encode({"type": kind, **fields}))


async def look(browser: ClientConnection) -> None:
    """Say where it looks from: viser calls a browser connected then."""
    await send(
        browser,
        "ViewerCameraMessage",
        wxyz=(1.0, 0.0, 0.0, 0.0),
        position=(0.0, 0.0, 0.0),
        fov=1.0,
        near=0.01,
        far=100.0,
        image_height=100,
        image_width=100,
        look_at=(0.0, 0.0, 1.0),
        up_direction=(0.0, -1.0, 0.0),
    )
