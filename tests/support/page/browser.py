"""A headless Chromium, driven through its DevTools protocol: what a person would do with a page, and what they see."""

from __future__ import annotations

import base64
import contextlib
import json
import os
import shutil
import signal
import subprocess
import tempfile
import time
import urllib.request
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

from websockets.sync.client import ClientConnection, connect

CHROMIUM = shutil.which("chromium") or shutil.which("chromium-browser") or shutil.which("google-chrome")
FLAGS = (
    "--headless=new",
    "--no-sandbox",
    "--disable-gpu",
    "--enable-unsafe-swiftshader",
    "--no-first-run",
    "--disable-background-networking",
    "--disable-component-update",
    "--disable-sync",
    "--disable-quic",
    "--mute-audio",
    "--hide-scrollbars",
    "--remote-debugging-port=0",
)
_START_S = 120.0
_REPLY_S = 120.0


class Browser:
    """One window of a browser with one page."""

    def __init__(self, url: str, width: int, height: int) -> None:
        """Open a page in a window of so many pixels; use `open_browser`, which closes it again."""
        if CHROMIUM is None:
            raise RuntimeError("no Chromium is installed")
        self._folder = tempfile.TemporaryDirectory(prefix="rhot-chromium-", ignore_cleanup_errors=True)
        self._process = subprocess.Popen(
            [
                *_kept_in_place(),
                CHROMIUM,
                *FLAGS,
                f"--user-data-dir={self._folder.name}",
                f"--window-size={width},{height}",
                "about:blank",
            ],
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
            start_new_session=True,
        )
        self.errors: list[str] = []
        self._number = 0
        try:
            self._socket = self._attached()
            for domain in ("Page", "Runtime", "Log"):
                self.command(f"{domain}.enable")
            self.command(
                "Emulation.setDeviceMetricsOverride", width=width, height=height, deviceScaleFactor=1, mobile=False
            )
            self.navigate(url)
        except BaseException:
            # Nobody else knows of it yet: it would draw on and slow everything after it.
            self.close()
            raise

    @property
    def pid(self) -> int:
        """Of the browser's first process."""
        return self._process.pid

    def _attached(self) -> ClientConnection:
        port_file = Path(self._folder.name) / "DevToolsActivePort"
        deadline = time.monotonic() + _START_S
        while time.monotonic() < deadline:
            with contextlib.suppress(OSError, IndexError, StopIteration, ValueError):
                port = int(port_file.read_text().splitlines()[0])
                with urllib.request.urlopen(f"http://127.0.0.1:{port}/json", timeout=2.0) as answer:
                    page = next(target for target in json.load(answer) if target["type"] == "page")
                return connect(page["webSocketDebuggerUrl"], max_size=None, compression=None)
            time.sleep(0.05)
        raise RuntimeError(f"Chromium did not come up within {_START_S:.0f} s")

    def command(self, method: str, **parameters: Any) -> dict[str, Any]:
        """Send one command and return its result; errors of the page that arrive meanwhile are kept."""
        self._number += 1
        self._socket.send(json.dumps({"id": self._number, "method": method, "params": parameters}))
        while True:
            message = json.loads(self._socket.recv(timeout=_REPLY_S))
            if message.get("id") == self._number:
                if "error" in message:
                    raise RuntimeError(f"{method}: {message['error']}")
                result: dict[str, Any] = message["result"]
                return result
            self._note(message)

    def _note(self, message: dict[str, Any]) -> None:
        parameters = message.get("params", {})
        if message.get("method") == "Runtime.exceptionThrown":
            self.errors.append(json.dumps(parameters["exceptionDetails"])[:500])
        elif message.get("method") == "Runtime.consoleAPICalled" and parameters["type"] in ("error", "assert"):
            self.errors.append(json.dumps(parameters["args"])[:500])
        elif message.get("method") == "Log.entryAdded" and parameters["entry"]["level"] == "error":
            self.errors.append(json.dumps(parameters["entry"])[:500])

    def navigate(self, url: str) -> None:
        """Open a page, and wait until its document is there: Chromium's reply comes before it is parsed."""
        answer = self.command("Page.navigate", url=url)
        if "errorText" in answer:
            raise RuntimeError(f"{url}: {answer['errorText']}")
        blank = json.dumps(url == "about:blank")
        self.wait_for(f"document.readyState === 'complete' && (location.href === 'about:blank') === {blank}")

    def evaluate(self, expression: str) -> Any:
        """Return the value of a JavaScript expression in the page."""
        answer = self.command("Runtime.evaluate", expression=expression, returnByValue=True, awaitPromise=True)
        if "exceptionDetails" in answer:
            raise RuntimeError(f"{expression}: {answer['exceptionDetails']}")
        return answer["result"].get("value")

    def wait_for(self, expression: str, timeout_s: float = 120.0) -> Any:
        """Return the value of an expression as soon as it is true-ish."""
        return wait_until(lambda: self.evaluate(expression), expression, timeout_s)

    def screenshot(self, jpeg_quality: int | None = None) -> bytes:
        """Return what the window shows, as PNG or, with a quality, as JPEG."""
        form = {"format": "png"} if jpeg_quality is None else {"format": "jpeg", "quality": jpeg_quality}
        return base64.b64decode(self.command("Page.captureScreenshot", **form)["data"])

    def click(self, x: float, y: float) -> None:
        """Click with the left button."""
        self.command("Input.dispatchMouseEvent", type="mouseMoved", x=x, y=y)
        for kind in ("mousePressed", "mouseReleased"):
            self.command("Input.dispatchMouseEvent", type=kind, x=x, y=y, button="left", clickCount=1)

    def click_text(self, text: str, tag: str = "button", timeout_s: float = 120.0) -> None:
        """Click the visible element of a kind that bears exactly this text, as soon as it can be clicked.

        Where the page moved under the pointer and something else was hit, it is clicked again, as a person would.
        """

        def hit() -> bool:
            place = self.evaluate(
                f"""(() => {{
                    const hit = [...document.querySelectorAll({json.dumps(tag)})].find(
                        e => e.textContent.trim() === {json.dumps(text)} && e.getClientRects().length);
                    if (!hit || hit.disabled) return null;
                    hit.scrollIntoView({{block: "center"}});
                    window.wasHit = false;
                    hit.addEventListener("pointerdown", () => {{ window.wasHit = true; }}, {{once: true}});
                    const box = hit.getBoundingClientRect();
                    return [box.x + box.width / 2, box.y + box.height / 2];
                }})()"""
            )
            if place is None:
                return False
            self.click(*place)
            return bool(self.evaluate("window.wasHit"))

        wait_until(hit, f"a click on {tag} {text!r}", timeout_s)

    def close(self) -> None:
        """End the browser."""
        with contextlib.suppress(Exception):
            self.command("Browser.close")
        with contextlib.suppress(Exception):
            self._socket.close()
        try:
            self._process.wait(timeout=5.0)
        except subprocess.TimeoutExpired:
            os.killpg(self._process.pid, signal.SIGKILL)
            self._process.wait()
        self._folder.cleanup()


def _kept_in_place() -> list[str]:
    """Return what goes before a command so that it ends with the process that started it, and yields to others as that.

    A killed pytest closes nothing, and Chromium as root gives itself and what draws for it a niceness of −8, before
    everything that is measured beside it.
    """
    ends = ["setpriv", "--pdeathsig", "KILL"]
    # A container may not be allowed to give rights away.
    for prefix in ([*ends, "--bounding-set", "-sys_nice"], ends):
        with contextlib.suppress(OSError):
            if subprocess.run([*prefix, "true"], capture_output=True, check=False).returncode == 0:
                return prefix
    return []


@contextlib.contextmanager
def open_browser(url: str, width: int = 1280, height: int = 800) -> Iterator[Browser]:
    """Open a page in a headless Chromium and end it afterwards."""
    browser = Browser(url, width, height)
    try:
        yield browser
    finally:
        browser.close()


def wait_until(condition: Callable[[], Any], what: str, timeout_s: float = 120.0) -> Any:
    """Return a condition's value as soon as it is true-ish."""
    deadline = time.monotonic() + timeout_s
    while not (value := condition()):
        if time.monotonic() > deadline:
            raise AssertionError(f"not within {timeout_s:.0f} s: {what}")
        time.sleep(0.05)
    return value
