"""The example page in a real browser, fed by the real bridge's WebSocket."""

from __future__ import annotations

import asyncio
import http.server
import threading
from collections.abc import Iterator
from functools import partial
from pathlib import Path

import pytest
from bridged import poses as bridge_poses
from bus_watch import PATIENCE_S
from page.browser import CHROMIUM, Browser, open_browser

from rhot_bridge.links import WebSocketLink
from rhot_bridge.targets.json_text import JsonTarget

EXAMPLES = Path(__file__).parents[2] / "examples"

pytestmark = [
    pytest.mark.integration,
    pytest.mark.skipif(CHROMIUM is None, reason="no Chromium on this machine (Debian: apt install chromium)"),
]


class Quiet(http.server.SimpleHTTPRequestHandler):
    def log_message(self, *_: object) -> None:
        """Say nothing."""


@pytest.fixture
def site() -> Iterator[str]:
    """The folder of examples, as `python -m http.server` shows it."""
    with http.server.ThreadingHTTPServer(("127.0.0.1", 0), partial(Quiet, directory=str(EXAMPLES))) as server:
        thread = threading.Thread(target=server.serve_forever, args=(0.05,))
        thread.start()
        yield f"http://127.0.0.1:{server.server_address[1]}"
        server.shutdown()
        thread.join()


def test_the_page_shows_both_hands(site: str, free_port: int) -> None:
    ended = threading.Event()

    async def send() -> None:
        link, target = WebSocketLink("127.0.0.1", free_port), JsonTarget("stage")
        await link.open()
        while not ended.is_set():
            link.send(target.frame(bridge_poses.scene("pointing"), 0))
            await asyncio.sleep(0.02)
        await link.close()

    bridge = threading.Thread(target=lambda: asyncio.run(send()))
    bridge.start()
    try:
        with open_browser(f"{site}/hand.html?ws://127.0.0.1:{free_port}", 800, 600) as browser:
            browser.wait_for("document.getElementById('said').textContent.includes('left hand: measured, right hand')")
            check(browser)
    finally:
        ended.set()
        bridge.join(PATIENCE_S)


def check(browser: Browser) -> None:
    assert browser.evaluate("window.frame.hands[0].positions.length") == 78
    wrist = browser.evaluate("window.frame.hands.find((h) => h.side === 'left').positions.slice(3, 6)")
    assert wrist == pytest.approx([-0.2, 1.1, -0.4], abs=1e-4)
    # From in front, turned a little: the left hand is drawn on the left, in blue, the right one on the right.
    middles = browser.evaluate(
        """(() => {
            turn = tilt = 0;
            middle = [0, 1.1, -0.4];
            show(window.frame);
            const { data, width } = draw.getImageData(0, 0, canvas.width, canvas.height);
            const found = { blue: [0, 0], orange: [0, 0] };
            for (let i = 0; i < data.length; i += 4) {
                if (data[i + 3] < 200) continue;
                const color = data[i + 2] > data[i] ? found.blue : found.orange;
                color[0] += (i / 4) % width; color[1]++;
            }
            return [found.blue[0] / found.blue[1] / width, found.orange[0] / found.orange[1] / width];
        })()"""
    )
    assert middles[0] < 0.45
    assert middles[1] > 0.55
    assert browser.errors == []
